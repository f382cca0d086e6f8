"""Logs of both ends of a Wi-Fi link: squares of the channel, their root along the way."""
# ruff: noqa: E501 (a case is a row of a table)

from pathlib import Path

import numpy as np
import pytest
from releases import real

from gsparc.data.datasets.own import read_any
from gsparc.data.datasets.wsr import (
    CARRIER_HZ,
    LOS_SET_A,
    RECORD,
    SPACING_HZ,
    TONES,
    _square,
    follow_root,
    read_log,
    read_wsr,
    remove_delay_slope,
)
from gsparc.data.load import load

RUN = "2021-06-27_202550"
FREQUENCY = CARRIER_HZ + SPACING_HZ * TONES
WALL = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1]])  # the transmitter, and its images in two walls
GAIN = np.array([1, 0.5, 0.35])


def channel(where: np.ndarray, transmitter) -> np.ndarray:
    """Channels (n, 30) of a direct path and two that are reflected."""
    images = np.asarray(transmitter) * WALL + np.array([[0, 0, 0], [-6.0, 0, 0], [0, 7.0, 0]])
    distance = np.linalg.norm(where[:, None] - images, axis=-1)
    phase = np.exp(-2j * np.pi * distance[..., None] * FREQUENCY / 299_792_458)
    return np.sum((GAIN / distance)[..., None] * phase, axis=1)


def records(csi, tick, time, number, sender) -> bytes:
    """A log of these channels (n, 30), as the card quantises them."""
    rows = np.zeros(len(csi), RECORD)
    rows["size"], rows["code"], rows["antennas"], rows["length"] = RECORD.itemsize - 2, 0xBB, (3, 1), 192
    gain = 40 - 20 * np.log10(np.linalg.norm(csi, axis=1))  # the strongest fills the converter
    rows["gain"], rows["rssi"] = 40, np.clip(np.round(84 - gain)[:, None] + [0, -40, -40], 0, 255)
    scaled = csi / np.abs(csi).max(axis=1, keepdims=True) * 90
    parts = np.zeros((len(csi), 30, 6), np.int8)
    parts[..., 0], parts[..., 1] = np.round(scaled.real), np.round(scaled.imag)
    bits = np.zeros((len(csi), 192 * 8), np.uint8)
    at = (3 + 51 * np.arange(30))[:, None] + np.arange(48)
    unpacked = np.unpackbits(parts.view(np.uint8)[..., None], axis=-1, bitorder="little")
    bits[:, at] = unpacked.reshape(len(csi), 30, 48)
    rows["csi"] = np.packbits(bits, axis=1, bitorder="little")
    rows["tick_us"], rows["number"] = np.round(1e6 * tick).astype(np.int64) % 2**32, number
    rows["second"], rows["microsecond"] = np.floor(time), np.round(1e6 * (time % 1))
    rows["sender"] = np.frombuffer(sender, "V6")
    return rows.tobytes()


def drive(
    folder: Path, name: str = "t1", packets: int = 600, lost: slice = slice(0, 0), seed: int = 0
) -> np.ndarray:
    """Logs of a robot that drives .6 m before three transmitters, with oscillators of their own; returns its way."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    start = 1_624_839_918.0
    usual = start + 0.008 * np.arange(packets) + rng.gamma(1.0, 50e-6, packets)
    where = np.stack(
        [np.linspace(0, 0.6, packets), 0.03 * np.sin(np.arange(packets) / 200), np.full(packets, 0.2)], 1
    )
    way = "".join(f"{t:.6f},0,{x:.6f},{y:.6f},{z:.6f},\n" for t, (x, y, z) in zip(usual, where, strict=True))
    (folder / f"rx_trajectory_{name}_.csv").write_text(way)
    robot, kept = [], np.delete(np.arange(packets), lost)
    for i, (tx, place) in enumerate(LOS_SET_A.items()):
        offset, sender = rng.uniform(-15e3, 15e3), bytes([0, 33, 106, 63, 23, 90 + 10 * (i + seed) % 100])
        there = usual + 0.0027 * i
        back = there + 100e-6 + rng.gamma(1.0, 16e-6, packets)  # waits for the channel
        h, logs = channel(where, place), []
        for time, sign in ((there, 1), (back, -1)):
            turn = np.exp(2j * np.pi * sign * offset * (time - start) + 1j * sign * 0.7 * i)
            delay = rng.uniform(0, 60e-9, packets)
            heard = h * turn[:, None] * np.exp(-2j * np.pi * SPACING_HZ * TONES * delay[:, None])
            logs.append(heard + 0.01 * np.abs(h).mean() * (rng.normal(size=(2, *h.shape)).T @ [1, 1j]).T)
        tick = there - start + 7.0, back - start + 900.0 + 3e-6 * i
        robot.append(records(logs[0], tick[0], there, np.arange(packets), sender))
        other = records(logs[1], tick[1], back + 40, np.arange(packets), bytes(6))
        size = RECORD.itemsize
        (folder / f"csi_{tx}_{name}.dat").write_bytes(
            b"".join(other[size * k : size * k + size] for k in kept)
        )
    (folder / f"csi_rx_{name}.dat").write_bytes(b"".join(robot))
    return where


def unexplained(found: np.ndarray, truth: np.ndarray) -> float:
    """NMSE with the best common factor."""
    return 1 - np.abs(np.vdot(found, truth)) ** 2 / (np.vdot(found, found) * np.vdot(truth, truth)).real


def true_root(where, transmitter) -> np.ndarray:
    """The channel without the slope of its square, which the clocks hide."""
    h = channel(where, transmitter)
    twice = remove_delay_slope(h**2) / h**2
    step = np.angle(twice[:, 1] / twice[:, 0]) / 2  # between tones -28 and -26
    return h * np.exp(0.5j * step[:, None] * TONES)


def test_the_channel_comes_back_up_to_a_factor_for_each_run(tmp_path):
    for i in range(2):
        drive(tmp_path / f"L{i}", f"t{i}", seed=i)
    raw = read_wsr(tmp_path).arrays
    assert len(set(raw["run"])) == 6 and set(raw["station"]) == {0, 1, 2}
    assert 30 <= np.min(np.unique(raw["run"], return_counts=True)[1]) <= 40  # .6 m in steps of 16 mm
    for run in np.unique(raw["run"]):
        rows = raw["run"] == run
        truth = true_root(raw["rx_position"][rows], raw["station_position"][raw["station"][rows][0]])
        assert unexplained(raw["csi"][rows], truth) < 0.03, run
    data = load({"name": "wsr", "file": str(tmp_path), "stations": ["tx3"]})
    assert data.site.kind == "csi" and data.target.shape[1:] == (1, 30) and len(set(data.run)) == 2
    assert "dataset=wsr" in read_any(tmp_path).notes[0]


def test_a_gap_begins_a_run(tmp_path):
    drive(tmp_path, lost=slice(300, 330))  # 3 cm without a packet
    assert set(read_wsr(tmp_path, spacing_m=0.02).arrays["run"]) == {
        f"t1 {tx} {part}" for tx in LOS_SET_A for part in (0, 1)
    }


def test_the_root_is_followed_through_a_fade():
    t = np.linspace(-1, 1, 400)[:, None]
    h = np.exp(3j * t) * (t + 0.1j + 0.2 * np.linspace(-1, 1, 30))
    assert unexplained(follow_root(h**2), h) < 1e-12


def test_pieces_of_the_release():
    """150 records of each end, of a robot that has not started yet: what is behind the archive's first row."""
    folder = real("releases/wsr")
    robot = read_log(folder / f"csi_rx_{RUN}.dat")
    senders = np.unique(robot.sender)
    with np.load(real("ofdm/wsr-los-a.npz")) as archive:
        first = (archive["run"] == list(archive["run_name"]).index(RUN)) & (archive["time_s"] < 0.2)
        converted = archive["h2"][first]
    assert robot.csi.shape == (150, 30, 3) and len(converted) == 3 and len(senders) == 3
    assert np.abs(robot.csi[..., 0]).sum() == pytest.approx(7.78434, rel=1e-5)
    for i, tx in enumerate(LOS_SET_A):
        other = read_log(folder / f"csi_{tx}_{RUN}.dat")
        agree, _, square = max((_square(robot, other, sender) for sender in senders), key=lambda one: one[0])
        others = sorted(_square(robot, other, sender)[0] for sender in senders)[:2]
        assert len(other.csi) == 150 and len(square) == 49 and agree > 0.94 and max(others) < 0.4
        mean = square.mean(axis=0)
        alike = np.abs(np.vdot(mean, converted[i])) / np.linalg.norm(mean) / np.linalg.norm(converted[i])
        assert alike > 0.7  # 9 mm further on: a third of a wavelength there and back
        assert abs(20 * np.log10(np.linalg.norm(mean) / np.linalg.norm(converted[i]))) < 3.5


def test_archives_read_as_they_did():
    held = read_wsr(real("ofdm/wsr-nlos-a.npz")).arrays
    with np.load(real("ofdm/wsr-nlos-a.npz")) as archive:
        good = archive["good"]
        assert np.allclose(held["csi"] ** 2, archive["h2"][good], rtol=1e-5)
        assert np.array_equal(held["station_position"], archive["tx_position"])
    assert "dataset=wsr" in read_any(real("ofdm/wsr-nlos-a.npz")).notes[0]


def test_logs_that_are_none(tmp_path, refused):
    refused("no csi_rx_\\*.dat in it", read_wsr, tmp_path)
    drive(tmp_path, packets=60)
    refused("no packet was heard at both ends while the robot drove", read_wsr, tmp_path, None, 5.0)
    refused("csi_tx9_t1.dat: missing", read_wsr, tmp_path, {"tx9": (0, 0, 0)})
    log = tmp_path / "csi_tx2_t1.dat"
    sound = log.read_bytes()
    log.write_bytes(sound[: 2 * RECORD.itemsize] + b"\0" + sound[2 * RECORD.itemsize :])
    refused("csi_tx2_t1.dat, record 2: expected packets of an Intel 5300", read_wsr, tmp_path)
    log.write_bytes(b"")
    refused("csi_tx2_t1.dat, record 0: expected packets", read_wsr, tmp_path)
    log.write_bytes(sound)
    (tmp_path / "rx_trajectory_t1_.csv").write_text("1,2\n3\n")
    refused("rx_trajectory_t1_.csv: expected lines that begin with the time", read_wsr, tmp_path)

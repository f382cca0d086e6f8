"""Logs of both ends of a Wi-Fi link: squares of the channel, their root along the way."""

import numpy as np
import pytest
from releases import real, release
from robots import RUN, drive, true_root

from gsparc.datasets.load import load
from gsparc.datasets.own import read_any
from gsparc.datasets.wsr import (
    LOS_SET_A,
    RECORD,
    _square,
    follow_root,
    read_log,
    read_wsr,
)


def unexplained(found: np.ndarray, truth: np.ndarray) -> float:
    """NMSE with the best common factor."""
    return (
        1
        - np.abs(np.vdot(found, truth)) ** 2 / (np.vdot(found, found) * np.vdot(truth, truth)).real
    )


@pytest.mark.slow
def test_the_channel_comes_back_up_to_a_factor_for_each_run(tmp_path):
    for i in range(2):
        drive(tmp_path / f"L{i}", f"t{i}", seed=i)
    raw = read_wsr(tmp_path).arrays
    assert len(set(raw["run"])) == 6 and set(raw["station"]) == {0, 1, 2}
    # .6 m in steps of 16 mm
    assert 30 <= np.min(np.unique(raw["run"], return_counts=True)[1]) <= 40
    for run in np.unique(raw["run"]):
        rows = raw["run"] == run
        truth = true_root(
            raw["rx_position"][rows], raw["station_position"][raw["station"][rows][0]]
        )
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
    """150 records of each end, of a robot that has not started yet:
    what is behind the archive's first row.
    """
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
        agree, _, square = max(
            (_square(robot, other, sender) for sender in senders), key=lambda one: one[0]
        )
        others = sorted(_square(robot, other, sender)[0] for sender in senders)[:2]
        assert len(other.csi) == 150 and len(square) == 49 and agree > 0.94 and max(others) < 0.4
        mean = square.mean(axis=0)
        alike = (
            np.abs(np.vdot(mean, converted[i]))
            / np.linalg.norm(mean)
            / np.linalg.norm(converted[i])
        )
        assert alike > 0.7  # 9 mm further on: a third of a wavelength there and back
        assert abs(20 * np.log10(np.linalg.norm(mean) / np.linalg.norm(converted[i]))) < 3.5


def test_archives_read_as_they_did():
    path = release("ofdm/wsr-nlos-a.npz")
    held = read_wsr(path).arrays
    with np.load(path) as archive:
        good = archive["good"]
        assert np.allclose(held["csi"] ** 2, archive["h2"][good], rtol=1e-5)
        assert np.array_equal(held["station_position"], archive["tx_position"])
    assert "dataset=wsr" in read_any(path).notes[0]


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

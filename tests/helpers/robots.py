"""A robot that drives before three Wi-Fi transmitters: its channels, and the logs of both ends."""

from pathlib import Path

import numpy as np

from gsparc.datasets.wsr import CARRIER_HZ, LOS_SET_A, RECORD, SPACING_HZ, TONES, remove_delay_slope

RUN = "2021-06-27_202550"  # of the release, of which pieces are beside this checkout
FREQUENCY = CARRIER_HZ + SPACING_HZ * TONES
WALL = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1]])  # the transmitter, and its images in two walls
GAIN = np.array([1, 0.5, 0.35])


def channel(where: np.ndarray, transmitter) -> np.ndarray:
    """Channels (n, 30) of a direct path and two that are reflected."""
    images = np.asarray(transmitter) * WALL + np.array([[0, 0, 0], [-6.0, 0, 0], [0, 7.0, 0]])
    distance = np.linalg.norm(where[:, None] - images, axis=-1)
    phase = np.exp(-2j * np.pi * distance[..., None] * FREQUENCY / 299_792_458)
    return np.sum((GAIN / distance)[..., None] * phase, axis=1)


def true_root(where, transmitter) -> np.ndarray:
    """The channel without the slope of its square, which the clocks hide."""
    h = channel(where, transmitter)
    twice = remove_delay_slope(h**2) / h**2
    step = np.angle(twice[:, 1] / twice[:, 0]) / 2  # between tones -28 and -26
    return h * np.exp(0.5j * step[:, None] * TONES)


def records(csi, tick, time, number, sender) -> bytes:
    """A log of these channels (n, 30), as the card quantises them."""
    rows = np.zeros(len(csi), RECORD)
    rows["size"], rows["code"], rows["antennas"], rows["length"] = (
        RECORD.itemsize - 2,
        0xBB,
        (3, 1),
        192,
    )
    gain = 40 - 20 * np.log10(np.linalg.norm(csi, axis=1))  # the strongest fills the converter
    rows["order"] = 0b100100
    rows["gain"] = 40
    rows["rssi"] = np.clip(np.round(84 - gain)[:, None] + [0, -40, -40], 1, 255)  # 0 is no antenna
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
    """Logs of a robot that drives .6 m before three transmitters, with oscillators of their own;
    returns its way.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    start = 1_624_839_918.0
    usual = start + 0.008 * np.arange(packets) + rng.gamma(1.0, 50e-6, packets)
    where = np.stack(
        [
            np.linspace(0, 0.6, packets),
            0.03 * np.sin(np.arange(packets) / 200),
            np.full(packets, 0.2),
        ],
        1,
    )
    way = "".join(
        f"{t:.6f},0,{x:.6f},{y:.6f},{z:.6f},\n" for t, (x, y, z) in zip(usual, where, strict=True)
    )
    (folder / f"rx_trajectory_{name}_.csv").write_text(way)
    robot, kept = [], np.delete(np.arange(packets), lost)
    for i, (tx, place) in enumerate(LOS_SET_A.items()):
        offset, sender = (
            rng.uniform(-15e3, 15e3),
            bytes([0, 33, 106, 63, 23, 90 + 10 * (i + seed) % 100]),
        )
        there = usual + 0.0027 * i
        back = there + 100e-6 + rng.gamma(1.0, 16e-6, packets)  # waits for the channel
        h, logs = channel(where, place), []
        for time, sign in ((there, 1), (back, -1)):
            turn = np.exp(2j * np.pi * sign * offset * (time - start) + 1j * sign * 0.7 * i)
            delay = rng.uniform(0, 60e-9, packets)
            heard = h * turn[:, None] * np.exp(-2j * np.pi * SPACING_HZ * TONES * delay[:, None])
            logs.append(
                heard + 0.01 * np.abs(h).mean() * (rng.normal(size=(2, *h.shape)).T @ [1, 1j]).T
            )
        tick = there - start + 7.0, back - start + 900.0 + 3e-6 * i
        robot.append(records(logs[0], tick[0], there, np.arange(packets), sender))
        other = records(logs[1], tick[1], back + 40, np.arange(packets), bytes(6))
        size = RECORD.itemsize
        (folder / f"csi_{tx}_{name}.dat").write_bytes(
            b"".join(other[size * k : size * k + size] for k in kept)
        )
    log = np.frombuffer(b"".join(robot), RECORD)
    (folder / f"csi_rx_{name}.dat").write_bytes(
        log[np.argsort(log["tick_us"], kind="stable")].tobytes()
    )
    return where

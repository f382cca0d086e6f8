"""Wi-Fi channels between a robot that drives and fixed transmitters (Harvard REACT,
WSR-Toolbox-Dataset).

The release is a folder, with any folders in it, of runs TIME: csi_rx_TIME.dat is the robot's log,
csi_txN_TIME.dat that of each transmitter, both of an Intel 5300 with the time and the counter of
each packet; rx_trajectory_TIME_.csv holds the robot's way, lines that begin with the time and end
with x, y, z [m]. The product of both directions of an exchange has no phase of oscillators: it is
the square of the channel, whose root is followed along the way.

The same as an npz: rx_position (S, 3), tx_position (T, 3) [m], tx_index (S,), segment (S,), h2 (S,
30), the square [mW], root_sign (S, 30), subcarrier_hz (30,), good (S,).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError, readable
from gsparc.base.files import read_csv
from gsparc.datasets.campaign import Campaign, read_converted
from gsparc.physics.decibels import from_decibels
from gsparc.tables.raw import Raw

CARRIER_HZ = 5.54e9  # Wi-Fi channel 108
# Of 64 that an Intel 5300 reports, at 20 MHz
TONES = np.array([*range(-28, 0, 2), -1, *range(1, 28, 2), 28])
SPACING_HZ = 312.5e3
RECORD = np.dtype(
    [
        ("size", ">u2"),
        ("code", "u1"),
        ("tick_us", "<u4"),
        ("skip", "V4"),
        ("antennas", "u1", 2),
        ("rssi", "u1", 3),
        ("noise", "i1"),
        ("gain", "u1"),
        ("order", "u1"),
        ("length", "<u2"),
        ("rate", "<u2"),
        ("second", "<u4"),
        ("microsecond", "<u4"),
        ("sender", "V6"),
        ("number", "<u4"),
        ("csi", "u1", 192),
    ]
)
EXPECTED = 0xBB, (3, 1), 192  # code, antennas and bytes of the channel in each record
LOS_SET_A = {"tx2": (-2.42, 2.65, 0.72), "tx3": (2.53, -2.65, 0.85), "tx4": (-3.73, -1.49, 0.35)}
MOST_OFFSET_HZ, OFFSET_STEP_HZ = 40e3, 50.0  # 7 ppm between the oscillators of two cards
LEAST_AGREEMENT = 0.6  # of neighbours: right pairs have .94 or more, others .36 or less
GAP_M = 0.007  # an eighth of a wavelength without a packet: the root's sign is lost
AVERAGED = 5  # packets of a row: within 3 mm

Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Log:
    """One end's packets: card's and computer's time [s], sender, counter, channel (n, 30, 3)
    [root of mW].
    """

    tick: np.ndarray
    time: np.ndarray
    sender: np.ndarray
    number: np.ndarray
    csi: np.ndarray


def read_wsr(
    path: str | Path,
    transmitters: Mapping[str, Sequence[float]] | None = None,
    spacing_m: float = 0.016,
) -> Raw:
    """Read a folder of runs, or an npz.

    Args:
        path: the folder, or *.npz.
        transmitters: places [m] by the names in the files of a folder; None: those of LOS_Set_A.
        spacing_m: way between rows of a folder [m].

    Returns:
        `rx_position` (S, 3), `station_position` (T, 3) [m], `station` (S,), `csi` (S, 30) [root of
        mW], with a factor of its own per `run` (S,), `frequency_hz` (30,);
        the delay of each row is removed.

    Raises:
        DataError: a log, a way or a transmitter's place is missing, damaged or another.
    """
    path = Path(path)
    if path.is_dir():
        return _of_release(path, LOS_SET_A if transmitters is None else transmitters, spacing_m)
    arrays = read_converted(path, "wsr npz").arrays
    arrays["csi"] = np.sqrt(arrays["csi"]) * arrays.pop("sign")
    good = arrays.pop("good")
    row_arrays = {name: arrays[name][good] for name in ("rx_position", "station", "run", "csi")}
    return Raw({**arrays, **row_arrays}, {"name": "wsr"})


def _of_release(root: Path, transmitters: Mapping[str, Sequence[float]], spacing_m: float) -> Raw:
    logs = sorted(root.rglob("csi_rx_*.dat"))
    if not logs:
        raise DataError(
            f"{root}: no csi_rx_*.dat in it; expected logs of a robot and of its transmitters"
        )
    names, rows = list(transmitters), list[tuple[np.ndarray, np.ndarray, int, str]]()
    for log in logs:
        time = log.stem.removeprefix("csi_rx_")
        robot, way = read_log(log), _way(log.with_name(f"rx_trajectory_{time}_.csv"))
        for name in names:
            other = read_log(log.with_name(f"csi_{name}_{time}.dat"))
            for part, (where, csi) in enumerate(_link(robot, other, way, spacing_m)):
                rows.append((where, csi, names.index(name), f"{time} {name} {part}"))
    if not rows:
        raise DataError(f"{root}: no packet was heard at both ends while the robot drove")
    count = [len(where) for where, *_ in rows]
    arrays = {
        "rx_position": np.concatenate([where for where, *_ in rows]),
        "station_position": np.array([transmitters[name] for name in names], np.float64),
        "station_name": np.array(names),
        "station": np.repeat([station for *_, station, _ in rows], count),
        "run": np.repeat([run for *_, run in rows], count),
        "csi": np.concatenate([csi for _, csi, *_ in rows]).astype(np.complex64),
        "frequency_hz": CARRIER_HZ + SPACING_HZ * TONES,
    }
    return Raw(arrays, {"name": "wsr"})


def read_log(path: Path) -> Log:
    """Read packets of an Intel 5300 with three antennas.

    Raises:
        DataError: missing, or its records are of another form.
    """
    with readable(path, "missing; expected the log of each end of a run", OSError):
        content = path.read_bytes()
    # The last may be cut short
    records = np.frombuffer(content, RECORD, len(content) // RECORD.itemsize)
    code, antennas, length = EXPECTED
    right = (records["size"] == RECORD.itemsize - 2) & (records["code"] == code)
    right &= (records["length"] == length) & (records["antennas"] == antennas).all(axis=1)
    if not len(records) or not right.all():
        number = int(np.argmin(right)) if len(records) else 0
        fault = (
            "expected packets of an Intel 5300 with three antennas, as the WSR toolbox logs them"
        )
        raise DataError(f"{path}, record {number}: {fault}")
    bits = np.unpackbits(records["csi"], axis=1, bitorder="little")
    # Three bits, then 8 of each real and imaginary part,
    # for each tone (Halperin et al., read_bfee.c).
    at = (3 + 51 * np.arange(30))[:, None] + np.arange(48)
    parts = np.packbits(bits[:, at].reshape(len(records), 30, 6, 8), axis=-1, bitorder="little")
    pairs = parts[..., 0].view(np.int8).astype(np.float64)
    csi = pairs[..., ::2] + 1j * pairs[..., 1::2]
    heard_mw = np.sum(from_decibels(records["rssi"]), axis=1) * from_decibels(
        -(44.0 + records["gain"])
    )
    scale = np.sqrt(heard_mw * len(TONES) / np.maximum(np.sum(np.abs(csi) ** 2, axis=(1, 2)), 1))
    time = records["second"] + 1e-6 * records["microsecond"]
    numbers = records["number"].astype(np.int64)
    # Antennas come in the order of the card's receivers, which changes from packet to packet.
    order = np.argsort(records["order"][:, None] >> [0, 2, 4] & 3, axis=1, kind="stable")
    csi = np.take_along_axis(csi, order[:, None], axis=2) * scale[:, None, None]
    return Log(1e-6 * records["tick_us"], time, records["sender"], numbers, csi)


def _way(path: Path) -> np.ndarray:
    """Time, x, y, z (n, 4) of the robot."""
    rows = read_csv(path, "missing; expected the robot's way")
    with readable(
        path,
        "expected lines that begin with the time and end with x, y, z",
        (ValueError, IndexError),
    ):
        way = np.array([[cell for cell in row if cell.strip()] for row in rows if row], np.float64)
        return way[:, [0, -3, -2, -1]]


def _link(robot: Log, other_robot: Log, way: np.ndarray, spacing_m: float) -> Iterator[Pair]:
    """Places (n, 3) and channels (n, 30) of each part of a run in
    which the root can be followed.
    """
    # A log does not name its own card: it is the sender with whose packets the oscillators cancel.
    trials = [_square(robot, other_robot, sender) for sender in np.unique(robot.sender)]
    agree, mine, square = max(trials, key=lambda one: one[0])
    if agree < LEAST_AGREEMENT:
        return
    place = np.stack(
        [np.interp(robot.time[mine], way[:, 0], axis) for axis in way[:, 1:].T], axis=1
    )
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    for part in np.split(np.arange(len(path)), np.flatnonzero(np.diff(path) > GAP_M) + 1):
        root = follow_root(square[part])
        step = np.floor(path[part] / spacing_m)
        centres = np.flatnonzero(np.diff(step, prepend=step[:1]) > 0)
        centres = centres[(centres >= AVERAGED // 2) & (centres < len(part) - AVERAGED // 2)]
        if len(centres):
            around = centres[:, None] + np.arange(AVERAGED) - AVERAGED // 2
            yield place[part][centres], root[around].mean(axis=1)


def _square(robot: Log, other_robot: Log, sender: np.void) -> tuple[float, np.ndarray, np.ndarray]:
    """How well neighbours agree (at most 1), the robot's packets (n,),
    the square of the channel (n, 30).
    """
    mine, theirs, late = _paired(robot, other_robot, sender)
    square = remove_delay_slope(robot.csi[mine, :, 0] * other_robot.csi[theirs, :, 0])
    turn, step = np.sum(square[1:] * square[:-1].conj(), axis=1), np.diff(late)
    # Of the two oscillators [Hz]
    offsets = np.arange(-MOST_OFFSET_HZ, MOST_OFFSET_HZ, OFFSET_STEP_HZ)
    agree = [np.real(np.sum(turn * np.exp(-2j * np.pi * hz * step))) for hz in offsets]
    offset = offsets[np.argmax(agree)]
    square *= np.exp(-2j * np.pi * offset * late)[:, None]
    return float(np.max(agree) / max(np.sum(np.abs(turn)), np.finfo(float).tiny)), mine, square


def _paired(
    robot: Log, other_robot: Log, sender: np.void
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Packets of one exchange by their counter, in both logs, and how late it was heard [s]."""
    packets = np.flatnonzero(robot.sender == sender)
    number, mine, theirs = np.intersect1d(
        robot.number[packets], other_robot.number, return_indices=True
    )
    late, usual = robot.tick[packets[mine]] - other_robot.tick[theirs], np.ones(len(number), bool)
    if len(number) < 2:
        return packets[:0], theirs[:0], late[:0]
    for _ in range(5):  # without the drift of the clocks; what waited for the channel is not usual
        fit = np.polynomial.Polynomial.fit(number[usual], late[usual], 1)
        rest = late - fit(number)
        usual = np.abs(rest) <= 4 * np.median(np.abs(rest)) + 1e-6
    return packets[mine], theirs, rest


def remove_delay_slope(csi: np.ndarray) -> np.ndarray:
    """Return channels (n, 30) without their phase's mean slope over tones,
    which holds the clocks' delay.
    """
    even = np.diff(TONES) == 2
    turn = np.angle(np.sum((csi[:, 1:] * csi[:, :-1].conj())[:, even], axis=1)) / 2
    return csi * np.exp(-1j * turn[:, None] * TONES)


def follow_root(square: np.ndarray) -> np.ndarray:
    """Return the root (n, K) of a square that changes little from row to row and
    from tone to tone.
    """
    root = np.sqrt(square)
    for tone in range(1, root.shape[1]):
        root[0, tone] *= np.where(np.real(root[0, tone] * root[0, tone - 1].conj()) < 0, -1, 1)
    for row in range(1, len(root)):
        before = root[max(row - 3, 0) : row].mean(axis=0)
        root[row] *= np.where(np.real(root[row] * before.conj()) < 0, -1, 1)
    return root


class WSR(Campaign):
    """Channels of 30 tones of a robot that drives; settings of `read_wsr` and `Campaign`."""

    choice, reader = "wsr", staticmethod(read_wsr)
    inside, marks = "**/csi_rx_*.dat", frozenset({"h2", "root_sign"})

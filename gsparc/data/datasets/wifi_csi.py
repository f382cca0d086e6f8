"""Wi-Fi channels as cards log them: one log, or a folder of logs, and a table that says where each was taken.

Places are a row per file (`file`, `x`, `y`), or a track (`time_s`, `x`, `y`) of all files or, with `file`, of
each; `z`, `rssi_dbm` and `channel` may stand beside them. Every packet is a row; those of one place share it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsparc.data.datasets.campaign import Campaign
from gsparc.data.datasets.wifi_logs import READERS, SUFFIXES, Packets, channel_hz, read_packets
from gsparc.data.datasets.wsr import SPACING_HZ
from gsparc.data.errors import DataError, some
from gsparc.data.files import read_csv
from gsparc.data.limits import choice, number, or_null
from gsparc.data.raw import Raw

log = logging.getLogger(__name__)

PLACES, NUMBERS = "places.csv", ("time_s", "x", "y", "z", "rssi_dbm", "channel")
CHIPS = ("43455c0", "4339", "4358", "4366c0")
# First and last subcarrier that a frame of 802.11a/g/n/ac fills, by the last that an FFT of its width has.
FILLED = {32: (1, 26), 64: (2, 58), 128: (2, 122)}
WEAK_DB, STRONG_DB = -20.0, 10.0  # of a subcarrier beside the others: nothing is sent below, junk is above
KEPT_DB = 2.0  # between the channel's power and RSSI, less a constant: the level is in the channel


@dataclass(frozen=True)
class Placed:
    """Packets of one log whose places are known: positions (n, 3) [m] beside those of `Packets`."""

    name: str
    packets: Packets
    position: np.ndarray
    rows: np.ndarray
    rssi_dbm: np.ndarray
    carrier_hz: float | None


def raw_of_wifi_csi(
    path: str | Path,
    places: str | Path | None = None,
    card: str | None = None,
    chip: str = CHIPS[0],
    carrier_hz: float | None = None,
    transmitters: Mapping[str, Sequence[float]] | None = None,
    level: str = "auto",
    target: str = "csi",
) -> Raw:
    """Read Wi-Fi logs; what was left out and where levels are from is logged.

    Args:
        path: a log, or a folder of them.
        places: the table of places; None: places.csv beside the logs.
        card, chip: see `read_packets`.
        carrier_hz: where neither logs nor places say a channel.
        transmitters: places [m] of senders by their addresses; None: nobody knows them.
        level: `rssi`, `channel`, or `auto`: RSSI where the gain control took the level out of the channel.
        target: `csi` or `rssi`, the mean level of each place.

    Returns:
        `rx_position` (S, 3), `station_position` (T, 3) [m], `station` (S,), `station_name` (T,), `time_s`
        (S,), and `csi` (S, A, K) [root of mW where RSSI is known] with `frequency_hz` (K,), subcarriers in
        ascending order, or `rssi_db` (S,) [dBm].

    Raises:
        DataError: a log or a place is missing or damaged, or logs are not of one kind.
        SettingError: a setting that cannot be.
    """
    or_null(choice(*READERS)).check("dataset.card", card)
    choice(*CHIPS).check("dataset.chip", chip)
    or_null(number(0, open_low=True)).check("dataset.carrier_hz", carrier_hz)
    choice("auto", "rssi", "channel").check("dataset.level", level)
    choice("csi", "rssi").check("dataset.target", target)
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    table = _Table.read(Path(places) if places else folder / PLACES)
    logs = list(_placed(_logs(path, card, table), table, card, chip))
    if not logs:
        raise DataError(f"{path}: no packet has a place in {table.path}; see the warnings above")
    first = logs[0]
    for one in logs:
        shape = one.packets.csi.shape[1:], one.carrier_hz
        if shape != (first.packets.csi.shape[1:], first.carrier_hz):
            what = f"antennas, subcarriers and carrier {shape}, those of {first.name} are others"
            raise DataError(f"{path}: {one.name} has {what}; give each kind a folder of its own")
    carrier = carrier_hz or first.carrier_hz
    if carrier is None:
        raise DataError(f"{path}: neither it nor {table.path} names the channel; say dataset.carrier_hz")
    csi = np.concatenate([one.packets.csi[one.rows] for one in logs])
    tone, csi = _filled(first.packets.tone, csi, path)
    rssi = np.concatenate([one.rssi_dbm for one in logs])
    sender = np.concatenate([one.packets.sender[one.rows] for one in logs])
    names, station = np.unique(sender, return_inverse=True)
    known, nowhere = dict(transmitters or {}), [np.nan] * 3
    for name in set(known) - set(names):
        raise DataError(f"dataset.transmitters: no packet is from {name!r}; there are {', '.join(names)}")
    arrays = {
        "rx_position": np.concatenate([one.position for one in logs]),
        "station_position": np.array([known.get(name, nowhere) for name in names], np.float64),
        "station_name": np.array([name or "transmitter" for name in names]),
        "station": station.reshape(-1),
        "time_s": np.concatenate([one.packets.time_s[one.rows] for one in logs]),
        "row_name": np.array([f"{one.name} packet {row}" for one in logs for row in one.rows]),
    }
    if target == "rssi":
        _refuse_missing(rssi, arrays["row_name"])
        link = np.column_stack([arrays["rx_position"], arrays["station"]])
        _, at, which = np.unique(link, axis=0, return_index=True, return_inverse=True)
        mean = np.bincount(which.reshape(-1), rssi) / np.bincount(which.reshape(-1))
        per_row = {name: array for name, array in arrays.items() if not name.startswith("station_")}
        arrays |= {name: array[at] for name, array in per_row.items()} | {"rssi_db": mean}
        return Raw(arrays, {"name": "wifi_csi", "level_unit": "dBm"})
    csi, unit = _levelled(csi, rssi, arrays["row_name"], level, path)
    arrays |= {"csi": csi.astype(np.complex64), "frequency_hz": carrier + SPACING_HZ * tone}
    return Raw(arrays, {"name": "wifi_csi", "level_unit": unit})


@dataclass(frozen=True)
class _Table:
    """Columns of a table of places, by head: numbers (n,), and names of files."""

    path: Path
    file: np.ndarray | None
    number: Mapping[str, np.ndarray]

    @staticmethod
    def read(path: Path) -> _Table:
        """`DataError` unless it has x, y and a file or a time."""
        lines = [row for row in read_csv(path, "missing; expected a table of places: dataset.places") if row]
        head = [name.strip().lower() for name in lines[0]] if lines else []
        if not {"x", "y"} <= set(head) or not {"file", "time_s"} & set(head):
            raise DataError(f"{path}: columns {', '.join(head)}; expected x, y [m], and file or time_s")
        columns = dict(zip(head, np.array([row[: len(head)] for row in lines[1:]]).T, strict=False))
        names: list[str] = [name for name in NUMBERS if name in columns]
        try:
            numbers = {name: columns[name].astype(np.float64) for name in names}
        except ValueError as error:
            raise DataError(f"{path}: {error}; expected numbers in {', '.join(names)}") from None
        return _Table(path, columns.get("file"), numbers)

    def of(self, name: str) -> dict[str, np.ndarray]:
        """The rows of one log, in order of time; without a column of files all rows are."""
        stem = name.rpartition(".")[0]
        mine = slice(None) if self.file is None else (self.file == name) | (self.file == stem)
        numbers = {key: column[mine] for key, column in self.number.items()}
        order = np.argsort(numbers.get("time_s", numbers["x"]), kind="stable")
        return {key: column[order] for key, column in numbers.items()}


def _logs(path: Path, card: str | None, table: _Table) -> list[Path]:
    if path.is_file():
        return [path]
    files = [one for one in sorted(path.rglob("*")) if one.resolve() != table.path.resolve()]
    endings = [ending for ending, of in SUFFIXES.items() if card in (None, of)] or [".dat"]
    for ending in endings:  # tables may lie beside logs
        found = [one for one in files if one.suffix.lower() == ending]
        if found:
            return found
    raise DataError(f"{path}: no such log, or a folder without {', '.join(endings)}")


def _placed(paths: Sequence[Path], table: _Table, card: str | None, chip: str) -> Iterator[Placed]:
    """Logs with packets whose places are known; of the others how many there are is logged."""
    without = []
    for path in paths:
        at = table.of(path.name)
        if not len(at["x"]):
            without.append(path.name)
            continue
        packets = read_packets(path, card, chip)
        time, rows = packets.time_s, np.arange(len(packets.csi))
        if "time_s" in at:
            rows = rows[(time >= at["time_s"][0]) & (time <= at["time_s"][-1])]
            if len(rows) < len(time):
                ends = f"{time.min():.3f} to {time.max():.3f} s, the track is {at['time_s'][[0, -1]]}"
                log.warning("%s: %d of %d packets left out: %s", path, len(time) - len(rows), len(time), ends)
        elif len(at["x"]) > 1:
            raise DataError(f"{table.path}: {path.name} has {len(at['x'])} places; expected one, or time_s")
        clock = at.pop("time_s", np.zeros(1))
        on = {key: np.interp(time[rows], clock, column) for key, column in at.items()}
        if not len(rows):
            continue
        rssi, zeros = packets.rssi_dbm[rows], np.zeros(len(rows))
        yield Placed(
            path.name, packets, np.stack([on["x"], on["y"], on.get("z", zeros)], 1), rows,
            np.where(np.isnan(rssi), on.get("rssi_dbm", rssi), rssi),
            packets.carrier_hz or (channel_hz(int(on["channel"][0])) if "channel" in on else None),
        )  # fmt: skip
    if without:
        log.warning("%s: no place for %d logs, left out: %s", table.path, len(without), some(without))
    if "z" not in table.number:
        log.info("%s: no column z: all places at height 0", table.path)


def _filled(tone: np.ndarray, csi: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Subcarriers (K',) in ascending order that carry the channel, and the channel (S, A, K') at them."""
    order = np.argsort(tone)
    tone, csi = tone[order], csi[..., order]
    low, high = FILLED.get(int(-tone.min()), (0, int(tone.max())))
    kept = (np.abs(tone) >= low) & (np.abs(tone) <= high)
    with np.errstate(divide="ignore", invalid="ignore"):
        power = 10 * np.log10(np.mean(np.abs(csi) ** 2, axis=1))
        beside = np.median(power - np.median(power[:, kept], axis=1, keepdims=True), axis=0)
    right = (beside > WEAK_DB) & (beside < STRONG_DB)
    if not (kept & right).any():
        raise DataError(f"{path}: no subcarrier has a level; is it a log of another card or chip?")
    if not (kept & right).all():
        odd = f", and {some(list(tone[kept & ~right]))}: their level is none" if (kept & ~right).any() else ""
        what = f"{(kept & right).sum()} of {len(tone)} subcarriers; guard and unused ones left out"
        log.info("%s: %s%s", path, what, odd)
    return tone[kept & right], csi[..., kept & right]


def _levelled(
    csi: np.ndarray, rssi_dbm: np.ndarray, names: np.ndarray, level: str, path: Path
) -> tuple[np.ndarray, str]:
    """Channels (S, A, K) at the level of their RSSI (S,) where that is not in them, and the level's unit."""
    with np.errstate(divide="ignore"):
        power_db = 10 * np.log10(np.sum(np.abs(csi) ** 2, axis=1).mean(axis=1))
    if level == "channel" or (level == "auto" and np.isnan(rssi_dbm).all()):
        if level == "auto":
            log.warning("%s: no RSSI: levels are what the gain control left, and may say nothing", path)
        return csi, "dB"
    _refuse_missing(rssi_dbm, names)
    apart = rssi_dbm - power_db
    if level == "auto" and np.std(apart) <= KEPT_DB:
        return csi * 10 ** (np.median(apart) / 20), "dBm"
    alike = np.corrcoef(power_db, rssi_dbm)[0, 1] if np.ptp(rssi_dbm) and np.ptp(power_db) else 0.0
    why = f"the channel's own power, after the gain control, correlates with it by {alike:.2f}"
    log.warning("%s: the level of each row is its RSSI; %s", path, why)
    return csi * (10 ** (apart / 20))[:, None, None], "dBm"


def _refuse_missing(rssi_dbm: np.ndarray, names: np.ndarray) -> None:
    missing = np.flatnonzero(np.isnan(rssi_dbm))
    if len(missing):
        where = f"{names[missing[0]]} and {len(missing) - 1} more"
        raise DataError(f"{where}: no RSSI in the log or in places (rssi_dbm); or say dataset.level=channel")


class WifiCsi(Campaign):
    """Wi-Fi channels as cards log them; settings of `raw_of_wifi_csi` and `Campaign`."""

    choice, reader = "wifi_csi", staticmethod(raw_of_wifi_csi)

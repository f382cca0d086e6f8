"""Wi-Fi channels as cards log them: one log, or a folder of logs,
and a table that says where each was taken.

Places are a row per file (`file`, `x`, `y`), or a track (`time_s`, `x`, `y`) of all files or, with
`file`, of each; `z`, `rssi_dbm` and `channel` may stand beside them. Every packet is a row;
those of one place share it.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsparc.base.errors import DataError, list_first, readable
from gsparc.base.files import read_csv
from gsparc.base.limits import choice, or_null
from gsparc.datasets.campaign import Campaign
from gsparc.datasets.wifi_logs import READERS, SUFFIXES, Packets, channel_hz, read_packets
from gsparc.datasets.wsr import SPACING_HZ
from gsparc.physics.decibels import to_decibels
from gsparc.tables.raw import Raw

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

PLACES, NUMBERS = "places.csv", ("time_s", "x", "y", "z", "rssi_dbm", "channel")
CHIPS = ("43455c0", "4339", "4358", "4366c0")
# First and last subcarrier that a frame of 802.11a/g/n/ac fills,
# by the last that an FFT of its width has.
FILLED = {32: (1, 26), 64: (2, 58), 128: (2, 122)}
# Of a subcarrier beside the others: nothing is sent below, junk is above
WEAK_DB, STRONG_DB = -20.0, 10.0
KEPT_DB = 2.0  # between the channel's power and RSSI, less a constant: the level is in the channel


def read_wifi_csi(
    path: str | Path,
    places: str | Path | None = None,
    card: str | None = None,
    chip: str = CHIPS[0],
    carrier_hz: float | None = None,
    transmitters: Mapping[str, Sequence[float]] | None = None,
) -> Raw:
    """Read Wi-Fi logs; what was left out and where levels are from is logged.

    Args:
        path: a log, or a folder of them.
        places: the table of places; None: places.csv beside the logs.
        card, chip: see `read_packets`.
        carrier_hz: where neither logs nor places say a channel.
        transmitters: places [m] of senders by their addresses; None: nobody knows them.

    Returns:
        `rx_position` (S, 3), `station_position` (T, 3) [m], `station` (S,), `station_name` (T,),
        `time_s` (S,), and `csi` (S, A, K) [root of mW where RSSI is known, of which the level is
        where the gain control took it out of the channel] with `frequency_hz` (K,),
        subcarriers in ascending order.

    Raises:
        DataError: a log or a place is missing or damaged, or logs are not of one kind.
        SettingError: a setting that cannot be.
    """
    or_null(choice(*READERS)).check("dataset.card", card)
    choice(*CHIPS).check("dataset.chip", chip)
    path = Path(path)
    table = _table(Path(places or (path if path.is_dir() else path.parent) / PLACES))
    logs = [_placed(log_file, table, card, chip) for log_file in _logs(path, card)]
    logs = [packets for packets in logs if len(packets.csi)]
    if not logs:
        raise DataError(
            f"{path}: no packet has a place in the table of places; see the warnings above"
        )
    kinds = sorted({(str(packets.csi.shape[1:]), packets.carrier_hz) for packets in logs}, key=str)
    if len(kinds) > 1:
        variants = f"antennas, subcarriers and carriers {list_first(kinds)}"
        raise DataError(f"{path}: {variants}; give each a folder of its own")
    carrier = carrier_hz or logs[0].carrier_hz
    if carrier is None:
        raise DataError(
            f"{path}: neither it nor the places name the channel; say dataset.carrier_hz"
        )
    of_packets = ("time_s", "sender", "csi", "rssi_dbm", "position")
    joined = [np.concatenate([getattr(packets, name) for packets in logs]) for name in of_packets]
    heard = (joined[2] != 0).any(axis=(1, 2))  # a packet of zeros has no level in dB
    if not heard.all():
        log.warning("%s: %d packets whose channels are zero are left out", path, (~heard).sum())
    time, sender, csi, rssi, position = (column[heard] for column in joined)
    tone, csi = _filled(logs[0].tone, csi, path)
    csi, unit = _levelled(csi, rssi, path)
    names, station = np.unique(sender, return_inverse=True)
    sender_places = dict(transmitters or {})
    for name in set(sender_places) - set(names):
        raise DataError(
            f"dataset.transmitters: no packet is from {name!r}; there are {', '.join(names)}"
        )
    arrays = {
        "rx_position": position,
        "station_position": np.array(
            [sender_places.get(name, [np.nan] * 3) for name in names], np.float64
        ),
        "station_name": np.array([name or "transmitter" for name in names]),
        "station": station.reshape(-1),
        "time_s": time,
        "csi": csi.astype(np.complex64),
        "frequency_hz": carrier + SPACING_HZ * tone,
    }
    return Raw(arrays, {"name": "wifi_csi", "level_unit": unit})


def _table(path: Path) -> pd.DataFrame:
    """The places; `DataError` unless it has x, y and a file or a time."""
    import pandas as pd  # here, as it takes half a second

    rows = read_csv(path, "missing; expected a table of places: dataset.places")
    head = [name.strip().lower() for name in rows[0]] if rows else []
    if not {"x", "y"} <= set(head) or not {"file", "time_s"} & set(head):
        raise DataError(f"{path}: columns {', '.join(head)}; expected x, y [m], and file or time_s")
    with readable(path, f"expected numbers in {', '.join(NUMBERS)}", (ValueError, AssertionError)):
        table = pd.DataFrame([row for row in rows[1:] if row], columns=head)
        return table.astype({name: float for name in NUMBERS if name in head})


def _logs(path: Path, card: str | None) -> list[Path]:
    if path.is_file():
        return [path]
    files = [file for file in sorted(path.rglob("*")) if file.name != PLACES]
    endings = [ending for ending, of in SUFFIXES.items() if card in (None, of)]
    for ending in endings:  # tables may lie beside logs
        logs = [file for file in files if file.suffix.lower() == ending]
        if logs:
            return logs
    raise DataError(f"{path}: no such log, or a folder without {', '.join(endings)}")


def _placed(path: Path, table: pd.DataFrame, card: str | None, chip: str) -> Packets:
    """Packets of a log whose places are known; how many are left out is logged."""
    at = table[table["file"].isin([path.name, path.stem])] if "file" in table else table
    packets = read_packets(path, card, chip)
    time = packets.time_s
    if "time_s" in at:
        at = at.sort_values("time_s")
        rows = np.flatnonzero((time >= at["time_s"].min()) & (time <= at["time_s"].max()))
        clock = at["time_s"]
    elif len(at) > 1:
        raise DataError(f"{path}: {len(at)} places of this file; expected one, or time_s")
    else:
        rows, clock = np.arange(len(at) * len(time)), np.zeros(len(at))
    if len(rows) < len(time):
        ends = f"no place for them; they are of {time.min():.3f} to {time.max():.3f} s"
        log.warning(
            "%s: %d of %d packets left out: %s", path, len(time) - len(rows), len(time), ends
        )
    on = {
        name: np.interp(time[rows], clock, at[name]) for name in NUMBERS if len(rows) and name in at
    }
    nothing, rssi = np.zeros(len(rows)), packets.rssi_dbm[rows]
    return replace(
        packets,
        time_s=time[rows],
        sender=packets.sender[rows],
        csi=packets.csi[rows],
        rssi_dbm=np.where(np.isnan(rssi), on.get("rssi_dbm", rssi), rssi),
        carrier_hz=packets.carrier_hz
        or (channel_hz(int(on["channel"][0])) if "channel" in on else None),
        position=np.stack([on.get(axis, nothing) for axis in "xyz"], 1),
    )


def _filled(tone: np.ndarray, csi: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Subcarriers (K',) in ascending order that carry the channel, and the channel (S, A, K')
    at them.
    """
    order = np.argsort(tone)
    tone, csi = tone[order], csi[..., order]
    low, high = FILLED.get(int(-tone.min()), (0, int(tone.max())))
    in_band = (np.abs(tone) >= low) & (np.abs(tone) <= high)
    with np.errstate(divide="ignore", invalid="ignore"):
        power = to_decibels(np.mean(np.abs(csi) ** 2, axis=1))
        beside = np.median(power - np.median(power[:, in_band], axis=1, keepdims=True), axis=0)
    right = (beside > WEAK_DB) & (beside < STRONG_DB)
    if not (in_band & right).any():
        raise DataError(f"{path}: no subcarrier has a level; is it a log of another card or chip?")
    if not (in_band & right).all():
        wrong = list(tone[in_band & ~right])
        odd = f", and {list_first(wrong)}: their level is none" if wrong else ""
        kept = (
            f"{(in_band & right).sum()} of {len(tone)} subcarriers; guard and unused ones left out"
        )
        log.info("%s: %s%s", path, kept, odd)
    return tone[in_band & right], csi[..., in_band & right]


def _levelled(csi: np.ndarray, rssi_dbm: np.ndarray, path: Path) -> tuple[np.ndarray, str]:
    """Channels (S, A, K) at the level of their RSSI (S,) where that is not in them,
    and the level's unit.
    """
    if np.isnan(rssi_dbm).all():
        log.warning("%s: no RSSI: levels are what the gain control left, and may say nothing", path)
        return csi, "dB"
    if np.isnan(rssi_dbm).any():
        count = np.isnan(rssi_dbm).sum()
        raise DataError(f"{path}: {count} packets without RSSI; give all places an rssi_dbm")
    power_db = to_decibels(np.sum(np.abs(csi) ** 2, axis=1).mean(axis=1))
    offset_db = rssi_dbm - power_db
    if np.std(offset_db) <= KEPT_DB:
        return csi * 10 ** (np.median(offset_db) / 20), "dBm"
    alike = np.corrcoef(power_db, rssi_dbm)[0, 1] if np.ptp(rssi_dbm) and np.ptp(power_db) else 0.0
    why = f"the channel's own power, after the gain control, correlates with it by {alike:.2f}"
    log.warning("%s: the level of each row is its RSSI; %s", path, why)
    return csi * (10 ** (offset_db / 20))[:, None, None], "dBm"


class WifiCsi(Campaign):
    """Wi-Fi channels as cards log them; settings of `read_wifi_csi` and `Campaign`."""

    choice, reader = "wifi_csi", staticmethod(read_wifi_csi)
    inside = "*.pcap"

"""What a list of sites says of its sectors, by the heads that planning tools write."""

from __future__ import annotations

import numpy as np
import pandas as pd

from gsparc.data.errors import Caution, list_first
from gsparc.data.files import read_shipped_table
from gsparc.data.tables.heads import LISTS, SHEET, unit_of, words_of
from gsparc.data.tables.sheet import Sheet

HEADS = {text: name for name, texts in SHEET["sectors"].items() for text in texts}
# 3GPP TS 36.101, table 5.7.3-1: lowest downlink frequency [MHz] of a band, and its first EARFCN.
BANDS = pd.DataFrame(read_shipped_table(__package__, "bands.csv")).astype(float).set_index("band")
TILTS = ("total", "mechanical", "electrical")
MOST_BAND = 90  # numbers beyond are frequencies [MHz]
MHZ = 1e6


def sector_quantity(head: str) -> str | None:
    """Return what a head of a list says of a sector; None: nothing."""
    words = " ".join(word for word in words_of(unit_of(head)[0]) if word not in LISTS["sector_beside"])
    return HEADS.get(words)


def earfcn_hz(channel: np.ndarray) -> np.ndarray:
    """Return downlink frequencies [Hz] of LTE channel numbers (n,), NaN of none (3GPP TS 36.101, 5.7.3)."""
    lowest, first = BANDS.sort_values("first_earfcn").to_numpy().T
    at = np.searchsorted(first, np.nan_to_num(channel, nan=-1), side="right") - 1
    return np.where(at >= 0, (lowest[at] + 0.1 * (channel - first[at])) * MHZ, np.nan)


def band_hz(band: np.ndarray) -> np.ndarray:
    """Return lowest downlink frequencies [Hz] of LTE bands (n,), or of [MHz] that name one."""
    known = BANDS["lowest_mhz"].reindex(np.nan_to_num(band).astype(int)).to_numpy()
    return np.where(band > MOST_BAND, band, known) * MHZ


def read_sectors(sheet: Sheet, used: set[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read arrays (T,) by name of a list's sectors, `height` and `carrier_hz` among them, and notes.

    Args:
        sheet: the list.
        used: heads that are read as something else.
    """
    found: dict[str, np.ndarray] = {}
    notes, unread, heads = [], [], []
    for head in [head for head in sheet.heads if head not in used]:
        name, unit = sector_quantity(head), unit_of(head)[1]
        words = sheet.words(head) if name else np.zeros(0, str)
        values = pd.to_numeric(pd.Series([_number(word) for word in words]), errors="coerce").to_numpy(float)
        if name is None or name in found or not np.isfinite(values).any():
            unread.append(repr(head))
            continue
        if name == "carrier_hz" and unit is None and np.nanmax(values) < MHZ:
            values = values * MHZ
        elif unit is not None and unit.kind == "power" and name == "station_power_db":
            with np.errstate(divide="ignore", invalid="ignore"):
                values = 10 * np.log10(unit.convert(values)) + 30
        elif unit is not None:
            values = unit.convert(values)
        found[name] = values
        heads.append(f"{head!r} as {name}")
    parts = [found.pop(name) for name in TILTS if name in found]
    if parts:
        total = np.nansum(parts[-2:] if len(parts) < 3 else parts[:1], axis=0)
        found["station_tilt"] = np.where(np.isnan(parts).all(0), np.nan, total)
    for name, turned in (("earfcn", earfcn_hz), ("band", band_hz)):
        if name in found:
            carrier = turned(found.pop(name))
            if np.isfinite(carrier).all():
                found.setdefault("carrier_hz", carrier)
    if heads:
        notes.append(f"{sheet.source}: of sectors {', '.join(heads)}")
    if unread:
        heads_ = f"column{'s' * (len(unread) > 1)} {list_first(unread, 8)}"
        notes.append(Caution(f"{sheet.source}: not read: {heads_}"))
    return found, notes


def number_sites(sheet: Sheet) -> tuple[str, np.ndarray] | None:
    """Return the head of a column that names the sites of a list, and their numbers (T,) float64, if any."""
    for head in sheet.heads:
        words = sheet.words(head) if " ".join(words_of(head)) in SHEET["sites"] else np.zeros(0, str)
        number, names = pd.factorize(words)
        if 1 < len(names) < len(words) and (words != "").all():
            return head, number.astype(np.float64)
    return None


def _number(word: str) -> str:
    """The number that a cell begins with: `30°`, `B20`, `1800 MHz`."""
    text = word.replace(",", ".").strip().lstrip("Bbn")
    return text.split()[0].rstrip("°") if text.split() else ""

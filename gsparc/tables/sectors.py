"""What a list of sites says of its sectors, by the heads that planning tools write."""

from __future__ import annotations

import re
from collections.abc import Container

import numpy as np
import pandas as pd

from gsparc.base.errors import Caution, DataError, list_first
from gsparc.base.files import read_shipped_table
from gsparc.data.units import UNITS, Unit, list_units
from gsparc.physics.decibels import to_decibels
from gsparc.tables.heads import LISTS, SHEET, unit_of, words_of
from gsparc.tables.sheet import Sheet

HEADS = {text: name for name, texts in SHEET["sectors"].items() for text in texts}
# 3GPP TS 36.101, table 5.7.3-1: lowest downlink frequency [MHz] of a band, and its first EARFCN.
BANDS = pd.DataFrame(read_shipped_table(__package__, "bands.csv")).astype(float).set_index("band")
TILTS = ("total", "mechanical", "electrical")
# Lowest and highest that there is, and what the largest reaches unless all are 0;
# the kind of their unit.
RANGES = {
    "station_azimuth": (-360, 360, 1, "angle"),
    "station_width": (0, 360, 1, "angle"),
    "station_thickness": (0, 360, 1, "angle"),
    **dict.fromkeys(TILTS, (-90, 90, 0.1, "angle")),
    "station_power_db": (-50, 100, 1, "power"),
    "height": (-500, 9000, 0.3, "length"),
    "carrier_hz": (2e8, 1.1e11, 0, "frequency"),
}
# Lowest and highest that are usual, and how far single ones are from the middle of all, at most.
USUAL = {
    "station_width": (6.3, 360, 360),
    "station_thickness": (2, 180, 180),
    "height": (0, 9000, 500),
    **dict.fromkeys(TILTS, (0, 30, 12)),
    "station_power_db": (-20, 80, 15),
}
# In place of a value that nobody knows
UNKNOWN = {
    "station_azimuth": -1,
    "station_power_db": 0,
    **dict.fromkeys(("station_width", "station_thickness"), 0),
}
UNSAID_DBM = 30  # a lower power, where nobody says its unit, may be in watts
FEW, LEAST = 0.2, 3  # share of a column up to which values are single ones; radians beside degrees
CELL = re.compile(r"(?i)^\s*[bn]?([-+]?\d*\.?\d+(?:e[-+]?\d+)?)\s*([a-zµμ%°]*)(?:\s.*)?$")
# Channel numbers of LTE are below; of NR 600,000 is 3 GHz (3GPP TS 38.104, table 5.4.2.1-1).
FIRST_NR = 100_000
WIDEST = 2000  # channels of a band of LTE, at most
NR_MHZ = np.array([[410, 7125], [24250, 71000]])  # where NR has bands (3GPP TS 38.104, 5.1)
MOST_BAND = 90  # numbers beyond are frequencies [MHz]
NEAR_BAND = 0.05  # share by which 700, 1800 or 3500 MHz miss the lowest of the band that they name
MHZ = 1e6


def sector_quantity(head: str) -> str | None:
    """Return what a head of a list says of a sector; None: nothing."""
    words = " ".join(
        word for word in words_of(unit_of(head)[0]) if word not in LISTS["sector_beside"]
    )
    return HEADS.get(words)


def earfcn_hz(channel: np.ndarray) -> np.ndarray:
    """Return downlink frequencies [Hz] of LTE or NR channel numbers (n,),
    NaN of none (TS 36.101, 5.7.3).
    """
    lowest, first = BANDS.sort_values("first_earfcn").to_numpy().T
    at = np.searchsorted(first, np.nan_to_num(channel, nan=-1), side="right") - 1
    offset = channel - first[at]
    lte = np.where((at >= 0) & (offset < WIDEST), lowest[at] + 0.1 * offset, np.nan)
    nr = np.where(channel < 600_000, 0.005 * channel, 3000 + 0.015 * (channel - 600_000))
    nr = np.where(channel < 2_016_667, nr, 24250.08 + 0.06 * (channel - 2_016_667))
    in_band = np.abs(nr[:, None] - NR_MHZ.mean(axis=1)) <= np.ptp(NR_MHZ, axis=1) / 2
    named = np.where(channel < FIRST_NR, lte, np.where(in_band.any(axis=1), nr, np.nan))
    return np.where(channel % 1 == 0, named, np.nan) * MHZ


def band_hz(band: np.ndarray) -> np.ndarray:
    """Return lowest downlink frequencies [Hz] of LTE bands (n,), or of [MHz] that name one;
    NaN of none.
    """
    band_mhz = BANDS["lowest_mhz"].reindex(np.nan_to_num(band).astype(int)).to_numpy()
    lowest = BANDS["lowest_mhz"].to_numpy()
    names = (abs(np.nan_to_num(band)[:, None] / lowest - 1) < NEAR_BAND).any(axis=1)
    return np.where(band > MOST_BAND, np.where(names, band, np.nan), band_mhz) * MHZ


def read_sectors(sheet: Sheet, used: Container[str | None]) -> dict[str, np.ndarray]:
    """Read arrays (T,) by name of a list's sectors, `height` and `carrier_hz` among them;
    with notes.

    Args:
        sheet: the list.
        used: heads that are read as something else.
    """
    columns: dict[str, np.ndarray] = {}
    notes, unread, heads = sheet.notes, [], []
    for head in [head for head in sheet.heads if head not in used]:
        name = sector_quantity(head)
        values, written, unit = _read_cells(sheet, head, name)
        if name is None or name in columns or not np.isfinite(values).any():
            unread.append(repr(head))
            continue
        meaning = name if unit is None or name != "carrier_hz" else f"{name} in {unit.name}"
        bad_rows = np.flatnonzero(np.isnan(values) & (sheet.words(head) != "") & np.isnan(written))
        if len(bad_rows):
            cells = list_first([f"'{sheet.words(head)[i]}' in {sheet.rows[i]}" for i in bad_rows])
            notes.append(Caution(f"{sheet.source}: column {head!r}: {cells}: no {name}; unknown"))
        mark = UNKNOWN.get(name)
        # A power of 0 dBm is one where others are about as low
        low = name == "station_power_db" and 0 < abs(np.nanmedian(values)) <= UNSAID_DBM
        if mark is not None and not low and (values == mark).any():
            values, meaning = np.where(values == mark, np.nan, values), f"{name}, {mark} unknown"
        if name in TILTS and (values < 0).any() and not (values > 0).any():
            notes.append(
                Caution(f"{sheet.source}: {head!r} are all below 0: read as below the horizon")
            )
            values = -values
        _doubt(sheet, head, name, values, unit is None)
        columns[name] = values
        heads.append(f"{head!r} as {meaning}")
    parts = [columns.pop(name) for name in TILTS if name in columns]
    if parts:
        total = np.nansum(parts[-2:] if len(parts) < 3 else parts[:1], axis=0)
        columns["station_tilt"] = np.where(np.isnan(parts).all(0), np.nan, total)
    for name, turned in (("earfcn", earfcn_hz), ("band", band_hz)):
        if name in columns:
            carrier = turned(columns.pop(name))
            if np.isfinite(carrier).all():
                columns.setdefault("carrier_hz", carrier)
                in_mhz = [f"{hertz / MHZ:g} MHz" for hertz in np.unique(carrier)]
                notes.append(f"{sheet.source}: carriers by {name}: {list_first(in_mhz, 4)}")
            elif "carrier_hz" not in columns:
                notes.append(
                    Caution(f"{sheet.source}: {name}: some of it names no frequency; not read")
                )
    if heads:
        notes.append(f"{sheet.source}: of sectors {', '.join(heads)}")
    if unread:
        heads_ = f"column{'s' * (len(unread) > 1)} {list_first(unread, 8)}"
        notes.append(Caution(f"{sheet.source}: not read: {heads_}"))
    return columns


def _read_cells(
    sheet: Sheet, head: str, name: str | None
) -> tuple[np.ndarray, np.ndarray, Unit | None]:
    """Read values (T,) in the schema's unit, by each cell's or the head's; those without;
    the head's unit.
    """
    cells = (
        pd.Series(sheet.words(head) if name else np.zeros(0, str))
        .str.replace(",", ".")
        .str.extract(CELL)
    )
    numbers, units = (
        pd.to_numeric(cells[0]).to_numpy(float),
        cells[1].fillna("").str.lower().to_numpy(),
    )
    unit = unit_of(head)[1] or UNITS.get(words_of(head)[-1])
    written, values = np.where(units == "", numbers, np.nan), np.full(len(units), np.nan)
    if name == "carrier_hz" and unit is None:  # their range is narrower than the steps of units
        hertz = [UNITS[name] for name in ("hz", "khz", "mhz", "ghz")]
        unit = next((candidate for candidate in hertz if _fits(candidate, written, name)), hertz[0])
    for text in np.unique(units):
        stated = UNITS.get(text) if text else unit or UNITS["m"]
        kinds = (
            (RANGES[name][3], *["level"] * (name == "station_power_db")) if name in RANGES else ()
        )
        if stated is not None and (stated.kind in kinds or not (text or unit)):
            values[units == text] = _convert(stated, numbers[units == text])
    return values, written, unit


def _convert(unit: Unit, values: np.ndarray) -> np.ndarray:
    """Values (n,) in a unit, in the schema's; powers in dBm."""
    with np.errstate(divide="ignore", invalid="ignore"):
        result = unit.convert(values)
        return to_decibels(result) + 30 if unit.kind == "power" else result


def _fits(unit: Unit, values: np.ndarray, name: str) -> bool:
    """Whether values (n,) that are in a unit can be those of a quantity of `RANGES`."""
    low, high, least, _ = RANGES[name]
    trial = _convert(unit, values[np.isfinite(values)])
    return not trial.any() or bool(
        ((trial >= low) & (trial <= high)).all() and np.abs(trial).max() >= least
    )


def _doubt(sheet: Sheet, head: str, name: str, values: np.ndarray, unsaid: bool) -> None:
    """Refuse values (T,) that cannot be (DataError), and doubt rare ones."""
    if name not in RANGES or np.isnan(values).all():
        return
    least, most, _, kind = RANGES[name]
    low, high, spread = USUAL.get(name, (least, most, np.inf))
    low = UNSAID_DBM if unsaid and kind == "power" else low
    refused, off = not _fits(UNITS["m"], values, name), (values < least) | (values > most)
    if not off.any():
        few = max(LEAST, FEW * len(values))
        off = refused & np.isfinite(values) | (values < low) | (values > high)
        # Degrees of azimuths are seldom as small
        turned = (values % 1 != 0) & (np.abs(values) < 2 * np.pi) & (name == "station_azimuth")
        off |= turned & (turned.sum() >= few)
        single = np.abs(values - np.nanmedian(values)) > spread
        off |= single & (single.sum() <= FEW * len(values))
    if off.any():
        cells = [f"{values[i]:g} in {sheet.rows[i]}" for i in np.flatnonzero(off)]
        fault = f"{sheet.source}: column {head!r} holds {list_first(cells, 3)}; expected {name} of "
        fault += f"{low:g} to {high:g}; in another unit? say in the cell, or in brackets in the "
        fault += f"head, which: {list_units(kind)}"
        if refused:
            raise DataError(fault)
        sheet.notes.append(Caution(fault))


def number_sites(sheet: Sheet) -> tuple[str, np.ndarray] | None:
    """Return the head of a column that names the sites of a list, and their numbers (T,) float64,
    if any.
    """
    for head in sheet.heads:
        words = (
            sheet.words(head) if " ".join(words_of(head)) in SHEET["sites"] else np.zeros(0, str)
        )
        number, names = pd.factorize(words)
        if 1 < len(names) < len(words) and (words != "").all():
            return head, number.astype(np.float64)
    return None

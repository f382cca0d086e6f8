"""Parts of a campaign: some stations, some runs, powers above a level, fewer rows; what goes is counted.

All work on the arrays of a file (`Raw`, named as in docs/reference/schema.md) before they are interpreted.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.blocks import take
from gsparc.data.errors import DataError
from gsparc.data.instantiate import suggest
from gsparc.data.limits import Checked, Limit, number, or_null, setting, whole
from gsparc.data.links.stations import station_number
from gsparc.data.raw import Noted, Raw, numbered_rows
from gsparc.data.schema import FIELDS, MEASUREMENTS, axes_from

FROM_ROW = " from row "  # in the name of a station that another one became by a step of its level
FEWEST = 2  # rows of a dataset
SEED = 0  # of the rows that `max_rows` keeps: the same in every run
# Names of arrays with a row per sample, station or path, and how many axes they then have.
ROW_AXES, STATION_AXES, PATH_AXES = axes_from("S"), axes_from("T"), axes_from("P")
# Arrays all of whose shapes begin with S: their first axis are rows, whatever else has that length.
ALWAYS = ("mask", "place", *(name for name in ROW_AXES if not re.search(r"\(\)|\([^S]", FIELDS[name].shape)))
SPLIT = ("split_train", "split_test")
Arrays = dict[str, np.ndarray]


def _listed(value: Any) -> Any:
    return (value,) if isinstance(value, str | int) else value


def _are_names(value: Any) -> bool:
    names = _listed(value)
    return isinstance(names, Sequence) and bool(names) and all(type(name) in (str, int) for name in names)


def _are_steps(value: Any) -> bool:
    rows = map(_listed, value.values()) if isinstance(value, Mapping) else [()]
    return all(isinstance(part, Sequence) and part and all(type(row) is int for row in part) for part in rows)


STEPS = or_null(Limit("first rows after steps by station, like {roof: [1162]},", _are_steps))
NAMED = or_null(Limit("a list of names like [A,B]", _are_names))


@dataclass(frozen=True)
class Selection(Checked):
    """The settings `dataset.stations`, `runs`, ..., of a part of a campaign; None leaves everything in.

    Attributes:
        stations: names, or numbers from 0, of the stations to keep.
        runs: names of the runs to keep.
        min_rssi_db: level [dB] below which powers are left out, as faults of the receiver.
        max_rows: largest number of rows (places of a wide file, links of a long one).
        level_steps: by station, rows (from 0) from which it counts as another.

    Raises:
        SettingError: a setting that cannot be.
    """

    stations: Sequence[str | int] | None = setting(None, NAMED)
    runs: Sequence[str | int] | None = setting(None, NAMED)
    min_rssi_db: float | None = setting(None, or_null(number(-math.inf)))
    max_rows: int | None = setting(None, or_null(whole(FEWEST)))
    level_steps: Mapping[str, Sequence[int]] | None = setting(None, STEPS)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("stations", "runs"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(_listed(getattr(self, name))))
        steps = {str(name): tuple(_listed(rows)) for name, rows in (self.level_steps or {}).items()}
        object.__setattr__(self, "level_steps", steps)


def select(raw: Raw, selection: Selection, source: str | Path) -> Noted:
    """Apply all settings: steps of levels, stations, runs, level, then number of rows.

    Raises:
        DataError: a setting that the file cannot follow, or nothing is left.
    """
    # Steps of levels come first: they divide stations, whose parts are then kept or left out together.
    raw, notes = split_stations(raw, selection.level_steps or {}, source), list[str]()
    steps: tuple[Callable[..., Noted], ...] = (keep_stations, keep_runs, keep_above, keep_rows)
    for keep, value in zip(steps, vars(selection).values(), strict=False):  # the last are level steps
        if value is not None:
            raw, more = keep(raw, value, source)
            notes += more
    return Noted(raw, tuple(notes))


def keep_stations(raw: Raw, stations: Iterable[str | int], source: str | Path) -> Noted:
    """Keep the links of some stations only; others' columns, or rows of a long file, are left out.

    Args:
        stations: names of `station_name`, or numbers from 0.

    Raises:
        DataError: the file has no stations, or not these.
    """
    count = _stations(raw, "dataset.stations", source)
    names = [str(name) for name in raw.arrays.get("station_name", np.zeros(0, str)).ravel()]
    numbers = [known_station(w, names, count, f"dataset.stations={w}", source) for w in stations]
    chosen = np.unique([part for number in numbers for part in parts_of(number, names)])
    note = f"dataset.stations: {count - len(chosen)} of {count} stations left out"
    part = take_stations(raw, chosen, source)
    part.arrays.setdefault("station_name", chosen.astype(str))  # what numbers call them does not change
    if "station" not in part.arrays:
        return Noted(part, (note,))
    part, more = _select(part, np.isin(raw.arrays["station"], chosen), "dataset.stations", source)
    part.arrays["station"] = np.searchsorted(chosen, part.arrays["station"])
    return Noted(part, (note, *more))


def keep_runs(raw: Raw, runs: Iterable[str | int], source: str | Path) -> Noted:
    """Keep the rows of some runs only.

    Raises:
        DataError: the file names no runs, or not these.
    """
    if "run" not in raw.arrays:
        raise DataError(f"dataset.runs: {source} names no runs; expected an array run")
    of_row = raw.arrays["run"].astype(str)
    known, wanted = np.unique(of_row).tolist(), [str(run) for run in runs]
    for name in wanted:
        if name not in known:
            raise DataError(f"dataset.runs={name}: no such run in {source}{suggest(name, known)}")
    return _select(raw, np.isin(of_row, wanted), f"dataset.runs={','.join(wanted)}", source)


def keep_above(raw: Raw, min_rssi_db: float, source: str | Path) -> Noted:
    """Keep powers of at least `min_rssi_db` [dB]; what is below is not measured, rather than not heard.

    Raises:
        DataError: the file holds no powers, or none is left.
    """
    name, option = _measurement(raw, source), f"dataset.min_rssi_db={min_rssi_db:g}"
    if name not in ("rssi", "rssi_db"):
        raise DataError(f"{option}: {source} holds {name}; expected powers, rssi or rssi_db")
    values, measured = raw.arrays[name], measured_links(raw, source)
    with np.errstate(divide="ignore", invalid="ignore"):
        # A power of 0 is minus infinity, below every level; NaN compares as False and stays missing.
        low = np.asarray(measured & ((10 * np.log10(values) if name == "rssi" else values) < min_rssi_db))
    if low.ndim == 1:
        return _select(raw, np.logical_not(low), option, source)
    # A wide file cannot leave out single links: they are marked as not measured.
    measured[low] = False
    marked = replace(raw, arrays={**raw.arrays, "mask": measured})
    links = (f"{option}: {int(low.sum())} links left out",) if low.any() else ()
    rest = _select(marked, np.asarray(measured.reshape(len(measured), -1).any(axis=1)), option, source)
    return Noted(rest.raw, (*links, *rest.notes))


def keep_rows(raw: Raw, max_rows: int, source: str | Path) -> Noted:
    """Keep at most `max_rows` rows, which cover the campaign as all rows do.

    The file's order is cut into `max_rows` stretches of equal length, and of each one row is drawn, with a
    fixed seed: every stretch of a walk stays, and rows of a raster are not hit in step with its lines, as
    every n-th would be.
    """
    count = row_count(raw, source)
    keep = np.ones(count, bool)
    if count > max_rows:
        edges = np.linspace(0, count, max_rows + 1)
        first, last = np.ceil(edges[:-1]).astype(int), np.ceil(edges[1:]).astype(int)
        keep = np.zeros(count, bool)
        keep[np.random.default_rng(SEED).integers(first, last)] = True
    return _select(raw, keep, f"dataset.max_rows={max_rows}", source)


def take_rows(arrays: Arrays, rows: np.ndarray, count: int, stations: int | None = None) -> Arrays:
    """Take rows (n,), which may repeat, of all arrays with one for each of `count`, splits and paths too.

    Arrays of another number of rows, and rows that a split names and that there are not, are left for whoever
    reads them to refuse. Splits without rows are left out.
    """
    part = dict(arrays)
    for name, array in arrays.items():
        if _of_rows(name, array, count, stations):
            part[name] = take(array, rows)
        elif name in SPLIT and array.ndim == 1 and array.dtype.kind in "iu":
            # Rows may repeat or be gone: a row of the split then stands in several places, or in none.
            order = np.argsort(rows, kind="stable")
            first, last = (np.searchsorted(rows[order], array, side) for side in ("left", "right"))
            outside = array[(array < 0) | (array >= count)]
            part[name] = np.concatenate([np.sort(order[_runs(first, last - first)]), outside])
    offsets = arrays.get("path_offsets")
    if offsets is not None and offsets.shape == (count + 1,) and offsets.dtype.kind in "iu":
        offsets = offsets.astype(np.int64)
        # Offsets that decrease are refused by whoever reads paths; until then such rows have none.
        lengths = np.diff(offsets).clip(0)[rows]
        part["path_offsets"] = np.concatenate([[0], np.cumsum(lengths)])
        for name in PATH_AXES:
            if name in arrays and arrays[name].shape[:1] == (offsets[-1],):
                part[name] = arrays[name][_runs(offsets[rows], lengths)]
    if any(name in part and not len(part[name]) for name in SPLIT):
        return {name: array for name, array in part.items() if name not in SPLIT}
    return part


def take_stations(raw: Raw, stations: np.ndarray, source: str | Path) -> Raw:
    """Return the same file with the stations (n,) only, in their order; one may stand twice.

    Rows of a long file stay as they are.

    Raises:
        DataError: a measurement has other columns than there are stations.
    """
    count, rows = station_count(raw), row_count(raw, source)
    assert count is not None
    arrays = dict(raw.arrays)
    for name, array in raw.arrays.items():
        if _of_stations(name, array, rows, count):
            arrays[name] = array[stations]
        elif name in (*MEASUREMENTS, "mask") and "station" not in arrays:
            if array.ndim < 2 or array.shape[1] != count:
                wanted = f"expected a column for each of the {count} stations, or an array station"
                raise DataError(f"{source}, {name}: {wanted}; found shape {array.shape}")
            arrays[name] = array[:, stations]
    return replace(raw, arrays=arrays)


def row_count(raw: Raw, source: str | Path) -> int:
    """Number of rows S of the measurement.

    Raises:
        DataError: the file holds no measurement, or a single number.
    """
    name = _measurement(raw, source)
    if raw.arrays[name].ndim == 0:
        raise DataError(f"{source}, {name}: expected a row per sample, found a single value")
    return len(raw.arrays[name])


def station_count(raw: Raw) -> int | None:
    """Number of stations T; None where the file has none."""
    for name in ("station_position", "station_latitude"):
        if name in raw.arrays and raw.arrays[name].ndim:
            return len(raw.arrays[name])
    return None


def _stations(raw: Raw, option: str, source: str | Path) -> int:
    count = station_count(raw)
    if count is None:
        raise DataError(f"{option}: {source} has no stations; expected station_position")
    return count


def parts_of(number: int, names: Sequence[str]) -> list[int]:
    """Return numbers of a station and its parts by level steps (`station_parts`), in the order of rows."""
    if number >= len(names):
        return [number]
    return [t for t, name in enumerate(names) if t == number or name.startswith(names[number] + FROM_ROW)]


def known_station(wanted: str | int, names: Sequence[str], count: int, option: str, file: str | Path) -> int:
    """Return `station_number`; errors name the setting `option` of a `file`.

    Raises:
        DataError: there is none.
    """
    number = station_number(wanted, names, count)
    if number is not None:
        return number
    if not names or (isinstance(wanted, int) and not any(name.isdigit() for name in names)):
        raise DataError(f"{option}: {file} has stations 0 to {count - 1}")
    raise DataError(f"{option}: no station {wanted} in {file}{suggest(str(wanted), names)}")


def _measurement(raw: Raw, source: str | Path) -> str:
    present, named = [n for n in MEASUREMENTS if n in raw.arrays], raw.attributes.get("measurement")
    if not present:
        raise DataError(f"{source}: expected one of {', '.join(MEASUREMENTS)}; found none of them")
    return str(named) if named in present else present[0]


def measured_links(raw: Raw, source: str | Path) -> np.ndarray:
    """Tell where the measurement says something: NaN is missing, or, with a sensitivity, not heard.

    Raises:
        DataError: the file holds no measurement, or a mask of another shape.
    """
    name, mask = _measurement(raw, source), raw.arrays.get("mask")
    values = raw.arrays[name]
    if mask is not None and mask.shape != values.shape:
        raise DataError(f"{source}, mask: expected shape {values.shape} as {name}, found {mask.shape}")
    if mask is not None:
        return mask.astype(bool)
    return np.ones(values.shape, bool) if "sensitivity_db" in raw.arrays else ~np.isnan(values)


def _of_stations(name: str, array: np.ndarray, rows: int, stations: int | None) -> bool:
    """Whether an array has an entry for each station; where rows are as many, carriers are of rows."""
    fits = array.ndim in STATION_AXES.get(name, ()) and len(array) == stations
    return fits and not (name == "carrier_hz" and rows == stations)


def _of_rows(name: str, array: np.ndarray, rows: int, stations: int | None) -> bool:
    """Whether an array has an entry for each row, by its name, its axes and how many there are."""
    known = name in ALWAYS or array.ndim in ROW_AXES.get(name, ())
    return known and array.shape[:1] == (rows,) and not _of_stations(name, array, rows, stations)


def _runs(first: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The numbers from each `first` (n,) on, `lengths` (n,) of them, one after the other."""
    return np.repeat(first - (np.cumsum(lengths) - lengths), lengths) + np.arange(lengths.sum())


def _select(raw: Raw, keep: np.ndarray, option: str, source: str | Path) -> Noted:
    rows, count = np.flatnonzero(keep), len(keep)
    if len(rows) < FEWEST:
        raise DataError(f"{option}: {len(rows)} rows of {source} are left; expected {FEWEST} or more")
    if len(rows) == count:
        return Noted(raw)
    named = {"row_name": numbered_rows(count), **raw.arrays}  # numbers stay the file's
    part = replace(raw, arrays=take_rows(named, rows, count, station_count(raw)))
    return Noted(part, (f"{option}: {count - len(rows)} of {count} rows left out",))


def split_stations(raw: Raw, steps: Mapping[str, Sequence[int]], source: str | Path) -> Raw:
    """Split each station of `steps` into several at one place, `NAME`, `NAME from row 1162`, ...

    Args:
        raw: arrays of a file, named as in docs/reference/schema.md.
        steps: by name or number of a station, the first rows (from 0) after each step.
        source: for messages.

    Raises:
        DataError: no such station or row, or the file has no stations.
    """
    for station, firsts in steps.items():
        # Ascending, so that each step divides the part after the one before.
        for first in sorted(firsts):
            raw = _split(raw, station, first, source)
    return raw


def _split(raw: Raw, station: str, first: int, source: str | Path) -> Raw:
    rows, option = row_count(raw, source), f"dataset.level_steps.{station}={first}"
    count = _stations(raw, option, source)
    if not 0 < first < rows:
        raise DataError(f"{option}: expected a row between 1 and {rows - 1}, of rows 0 to {rows - 1}")
    names = [str(name) for name in raw.arrays.get("station_name", np.arange(count)).ravel()]
    number = known_station(station, names, count, option, source)
    last = parts_of(number, names)[-1]  # later steps divide the part after earlier ones
    doubled = np.array([*range(count), last])
    raw = replace(raw, arrays={**raw.arrays, "station_name": np.array(names)})
    after = np.arange(rows) >= first
    if "station" not in raw.arrays:
        raw.arrays["mask"] = measured_links(raw, source)
    arrays = take_stations(raw, doubled, source).arrays
    arrays["station_name"] = np.array([*names, f"{names[number]}{FROM_ROW}{first}"])
    if "station" in arrays:
        arrays["station"] = np.where((arrays["station"] == last) & after, count, arrays["station"])
    else:
        # Before its step the new station was silent, and after it the old one.
        arrays["mask"][~after, count] = arrays["mask"][after, last] = False
    return replace(raw, arrays=arrays)

"""Parts of a campaign: some stations, some runs, powers above a level, fewer rows;
what goes is counted.

Rows are links by then: arrays named as in docs/reference/schema.md,
`station` and `file_row` of each row.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError, list_first, suggest_name
from gsparc.base.hashes import hash_rows
from gsparc.base.limits import Checked, Limit, choice, number, or_null, setting, whole
from gsparc.data.assemble import FARTHEST
from gsparc.data.blocks import take
from gsparc.data.fields import FIELDS, list_arrays_with_axis
from gsparc.data.row_order import find_copies, merge_fixes
from gsparc.data.schema import Stations
from gsparc.data.spacing import group_visits
from gsparc.data.station_names import find_station
from gsparc.physics.decibels import from_decibels, to_decibels

FROM_ROW = " from row "  # in the name of a station that another one became by a step of its level
FEWEST = 2  # rows of a dataset
FIX_S = 60.0  # that rows of one fix are apart at most
SEED = 0  # of the rows that `max_rows` keeps: the same in every run
# Names of arrays with a row per sample or path, and how many axes they then have.
ROW_AXES, PATH_AXES = list_arrays_with_axis("S"), list_arrays_with_axis("P")
# Arrays all of whose shapes begin with S: their first axis are rows, whatever else has that length.
OF_ROWS = {
    name for name, field in FIELDS.items() if all(shape[:1] == ("S",) for shape in field.shapes)
}
ALWAYS = {"place", "file_row", *OF_ROWS}
SPLIT = ("split_train", "split_test")
Arrays = dict[str, np.ndarray]


def _listed(value: Any) -> Any:
    return (value,) if isinstance(value, str | int) else value


def _are_names(value: Any) -> bool:
    names = _listed(value)
    return (
        isinstance(names, Sequence)
        and bool(names)
        and all(type(name) in (str, int) for name in names)
    )


def _are_steps(value: Any) -> bool:
    rows = map(_listed, value.values()) if isinstance(value, Mapping) else [()]
    return all(
        isinstance(part, Sequence) and part and all(type(row) is int for row in part)
        for part in rows
    )


STEPS = or_null(Limit("first rows after steps by station, like {roof: [1162]},", _are_steps))
NAMED = or_null(Limit("a list of names like [A,B]", _are_names))


@dataclass(frozen=True)
class Selection(Checked):
    """The settings `dataset.stations`, `runs`, ..., of a part of a campaign;
    None leaves everything in.

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


WHOLE = Selection()


def pop_selection(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of `Selection` out of all of a dataset, which then lack them."""
    return {
        setting_field.name: settings.pop(setting_field.name)
        for setting_field in fields(Selection)
        if setting_field.name in settings
    }


Part = tuple[Arrays, Stations | None, list[str]]


def select(
    arrays: Arrays, measured: str, stations: Stations | None, part: Selection, source: str
) -> Part:
    """Apply all settings: steps of levels, stations, runs, level, copies, then number of rows.

    Args:
        arrays: of links.
        measured: name of the measurement.
        stations: of the links; None: the file has none.
        part: the settings.
        source: of the file, for messages.

    Returns:
        The arrays and stations that are left, and notes of what is not.

    Raises:
        DataError: a setting that the file cannot follow, or fewer than two rows are left.
    """
    notes: list[str] = []

    def kept(option: str, keep: np.ndarray) -> Arrays:
        if keep.all():
            return arrays
        if keep.sum() < FEWEST:
            raise DataError(
                f"{option}: {keep.sum()} rows of {source} are left; expected {FEWEST} or more"
            )
        notes.append(f"{option}: {(~keep).sum()} of {len(keep)} rows left out")
        return take_rows(arrays, np.flatnonzero(keep), len(keep))

    # Steps of levels come first: they divide stations,
    # whose parts are then kept or left out together.
    for name, firsts in (part.level_steps or {}).items():
        # Ascending, so that each step divides the part after the one before
        for first in sorted(firsts):
            arrays, stations = _split(
                arrays, _there(stations, "level_steps", source), name, first, source
            )
    if part.stations is not None:
        stations = _there(stations, "stations", source)
        numbers = (
            _number(stations, station, f"dataset.stations={station}", source)
            for station in part.stations
        )
        chosen = np.unique(
            [t for station_number in numbers for t in _parts(stations, station_number)]
        )
        arrays = dict(kept("dataset.stations", np.isin(arrays["station"], chosen)))
        arrays["station"], stations = (
            np.searchsorted(chosen, arrays["station"]),
            stations.subset(chosen),
        )
    if part.runs is not None:
        arrays = kept(
            f"dataset.runs={','.join(map(str, part.runs))}", _of_runs(arrays, part.runs, source)
        )
    if part.min_rssi_db is not None:
        option = f"dataset.min_rssi_db={part.min_rssi_db:g}"
        if measured not in ("rssi", "rssi_db"):
            raise DataError(
                f"{option}: {source} holds {measured}; expected powers, rssi or rssi_db"
            )
        with np.errstate(divide="ignore", invalid="ignore"):
            # A power of 0 is minus infinity, below every level;
            # NaN compares as False and stays missing.
            level = to_decibels(arrays[measured]) if measured == "rssi" else arrays[measured]
            arrays = kept(option, np.logical_not(level < part.min_rssi_db))
    arrays, copies, how = _copies(arrays, measured)
    arrays = kept(how, ~copies)
    if part.max_rows is not None:
        arrays = kept(
            f"dataset.max_rows={part.max_rows}", _spread(arrays["file_row"], part.max_rows)
        )
    return arrays, stations, notes


def _copies(arrays: Arrays, measured: str) -> tuple[Arrays, np.ndarray, str]:
    """Arrays with means of levels that were read at one fix, the rows beyond,
    and what these are.
    """
    rows, number, device = len(arrays[measured]), arrays.get("station"), arrays.get("device")
    ends = [arrays.get(f"{end}_position", np.zeros(0)) for end in ("rx", "tx")]
    places = [
        end.astype(np.float64) for end in ends if end.shape == (rows, 3) and end.dtype.kind in "iuf"
    ]
    how = "copies of other rows (same places, station and values)"
    if not places:  # one that repeats is no row's own
        return arrays, np.zeros(rows, bool), how
    place, whole = hash_rows(*places), np.hstack(places)
    exact = place.copy()
    valid = np.flatnonzero((np.abs(whole) <= FARTHEST).all(axis=1))
    # The position of a packet that is logged twice may jitter; real visits differ in their levels.
    if len(valid) > 1 and (near := group_visits(whole[valid])) is not None:
        place[valid] = near
    # Two devices that read the same level at one place are two measurements.
    if device is not None:
        alike = np.unique(device.astype(str), return_inverse=True)[1].reshape(-1)
        device = alike if len(alike) == rows else None
    values = arrays[measured]
    if measured not in ("rssi", "rssi_db") or values.shape != (rows,) or values.dtype.kind != "f":
        return arrays, find_copies(hash_rows(place, number, device), values), how
    # What else tells rows of a place apart
    told = [number, device]
    for name, unit in (("run", None), ("time_s", FIX_S), ("carrier_hz", None)):
        part = arrays.get(name, np.zeros(0))
        if part.shape == (rows,):
            part = part // unit if unit and part.dtype.kind in "iuf" else part
            told.append(np.unique(part, return_inverse=True)[1].reshape(-1))
    link, fix = hash_rows(place, *told), hash_rows(exact, *told)
    reader = np.zeros(rows, np.int64) if device is None else device
    with np.errstate(divide="ignore", invalid="ignore"):
        level = to_decibels(values) if measured == "rssi" else values.astype(np.float64)
    finite = np.where((np.abs(whole) <= FARTHEST).all(1), level, np.nan)
    means, copies = merge_fixes(link, fix, finite, reader)
    changed = np.isfinite(means) & (means != level)
    if changed.any():
        mean = from_decibels(means) if measured == "rssi" else means
        arrays = {**arrays, measured: np.where(changed, mean, values).astype(values.dtype)}
        how = "rows of one fix are one, with their mean level, and copies"
    return arrays, copies, how


def _there(stations: Stations | None, name: str, source: str) -> Stations:
    if stations is None:
        raise DataError(f"dataset.{name}: {source} has no stations; expected station_position")
    return stations


def _number(stations: Stations, wanted: str | int, option: str, source: str) -> int:
    number = find_station(wanted, stations)
    if number is None:
        hint = suggest_name(str(wanted), stations.name, 0.6) or (
            f"; there are {list_first(stations.shown, 9)}"
        )
        if Path(str(wanted)).is_file():
            hint = f"; a table of them is dataset.stations_file={wanted}"
        raise DataError(f"{option}: no station {wanted} in {source}{hint}")
    return number


def _parts(stations: Stations, number: int) -> list[int]:
    """Numbers of a station and its parts by level steps, in the order of rows."""
    begins = stations.name[number] + FROM_ROW
    return [number, *(t for t, name in enumerate(stations.name) if name.startswith(begins))]


def _split(
    arrays: Arrays, of: Stations, name: str, first: int, source: str
) -> tuple[Arrays, Stations]:
    """Rows of a station from `first` of the file on are those of another one, at the same place."""
    rows, option = int(arrays["file_row"].max()) + 1, f"dataset.level_steps.{name}={first}"
    if not 0 < first < rows:
        raise DataError(
            f"{option}: expected a row between 1 and {rows - 1}, of rows 0 to {rows - 1}"
        )
    number = _number(of, name, option, source)
    last = _parts(of, number)[-1]  # later steps divide the part after earlier ones
    after = (arrays["station"] == last) & (arrays["file_row"] >= first)
    more = of.subset(
        np.array([*range(len(of)), last]), [*of.name, f"{of.name[number]}{FROM_ROW}{first}"]
    )
    return {**arrays, "station": np.where(after, len(of), arrays["station"])}, more


def _of_runs(arrays: Arrays, runs: Sequence[str | int], source: str) -> np.ndarray:
    if "run" not in arrays:
        raise DataError(f"dataset.runs: {source} names no runs; expected an array run")
    of_row = arrays["run"].astype(str)
    wanted, of_file = [str(run) for run in runs], choice(*np.unique(of_row).tolist())
    for run in wanted:
        of_file.check("dataset.runs", run)
    return np.isin(of_row, wanted)


def _spread(file_row: np.ndarray, most: int) -> np.ndarray:
    """At most so many rows of the file, which cover the campaign as all do.

    The file's order is cut into stretches of equal length, and of each one row is drawn: every
    stretch of a walk stays, and rows of a raster are not hit in step with its lines,
    as every n-th would be.
    """
    rows, which = np.unique(file_row, return_inverse=True)
    if len(rows) <= most:
        return np.ones(len(file_row), bool)
    edges = np.ceil(np.linspace(0, len(rows), most + 1)).astype(int)
    drawn = np.random.default_rng(SEED).integers(edges[:-1], edges[1:])
    return np.isin(which.reshape(-1), drawn)


def take_rows(arrays: Arrays, rows: np.ndarray, count: int) -> Arrays:
    """Take rows (n,), which may repeat, of all arrays with one for each of `count`,
    splits and paths too.

    Arrays of another number of rows, and rows that a split names and that there are not, are left
    for whoever reads them to refuse. Splits without rows are left out.
    """
    part = dict(arrays)
    for name, array in arrays.items():
        if (name in ALWAYS or array.ndim in ROW_AXES.get(name, ())) and array.shape[:1] == (count,):
            part[name] = take(array, rows)
        elif name in SPLIT:
            # Rows may repeat or be gone: a row of the split then stands in several places,
            # or in none.
            order = np.argsort(rows, kind="stable")
            first, last = (np.searchsorted(rows[order], array, side) for side in ("left", "right"))
            outside = array[(array < 0) | (array >= count)]
            part[name] = np.concatenate([np.sort(order[_runs(first, last - first)]), outside])
    offsets = arrays.get("path_offsets")
    if offsets is not None and offsets.shape == (count + 1,):
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


def _runs(first: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The numbers from each `first` (n,) on, `lengths` (n,) of them, one after the other."""
    return np.repeat(first - (np.cumsum(lengths) - lengths), lengths) + np.arange(lengths.sum())

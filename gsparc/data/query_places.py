"""Places that a model is asked about, from a table or from arrays: nothing measured is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsparc.data.errors import DataError
from gsparc.data.links.georeference import bad_degrees
from gsparc.data.own_checks import Checker
from gsparc.data.raw import Raw, read_raw
from gsparc.data.schema import ENDS, End
from gsparc.data.tables import is_table
from gsparc.data.tables.columns import Chosen, choose
from gsparc.data.tables.heads import AXES
from gsparc.data.tables.opening import sheet_of
from gsparc.data.tables.places import Places, places
from gsparc.data.tables.read import NOTHING
from gsparc.data.tables.sheet import Sheet

# Only what a query needs: a column that looks like a level is none of its concern.
GUESSED = (*(f"{end}{axis}" for end in ("", "rx_", "tx_") for axis in AXES), "station")


@dataclass(frozen=True)
class QueryPlaces:
    """Places in the order of their file.

    Attributes:
        source: the file, for messages.
        ends: places (n,) of each end that moves, as they were given.
        rows: (n,) what messages call each.
        station: (n,) names; None where the file names none.
        plain: (n,) the same without what several columns may add to them.
        name: (n,) what a user calls each, where a column says so; else None.
        notes: what was guessed or not used, one line each.
        table: the columns of a table in order: head, quantity that was read out of it or None, text (n,).
    """

    source: str
    ends: dict[End, Places]
    rows: tuple[str, ...]
    station: np.ndarray | None = None
    plain: np.ndarray | None = None
    name: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    table: tuple[tuple[str, str | None, np.ndarray], ...] = ()

    def __len__(self) -> int:
        return len(self.rows)


def read_query_places(
    path: str | Path, moving: Sequence[End], columns: Mapping[str, object] = NOTHING
) -> QueryPlaces:
    """Read places of the ends that move.

    Args:
        path: a table (*.csv, *.tsv, *.txt, *.parquet), or *.npz or HDF5 with `latitude` and `longitude`,
            `rx_position` or `tx_position`, a height, and `station`.
        moving: one end, or both.
        columns: of a table, by quantity, where the guess from their heads will not do.

    Raises:
        DataError: no file, no places, or a place that is none; the first problem, with row and column.
    """
    try:
        if is_table(path):
            return _of_table(path, moving, columns)
        named = [name for name, value in columns.items() if value is not None]
        # Settings of columns have no meaning for named arrays, and would be ignored without a word.
        if named:
            raise DataError(f"columns.{named[0]}: goes with tables (*.csv, *.parquet), not with {path}")
        return _of_arrays(read_raw(path), str(path), moving)
    except DataError as error:
        # Measurements are checked by `gsparc check`; places are not, and here their settings are called so.
        first = error.problems[0].replace("dataset.columns", "columns")
        # The first problem alone: a table of queries is mostly wrong in the same way in every row.
        more = len(error.problems) - 1
        raise DataError(first + (f" (and {more} more)" if more else "")) from None


def read_times(path: str | Path) -> np.ndarray | None:
    """Read when (n,) [s] each place was visited, column or array `time_s`; None where there is none.

    Raises:
        DataError: no such file, or a time that is no number, with its row.
    """
    if is_table(path):
        sheet, _ = sheet_of(path)
        if "time_s" not in sheet.heads:
            return None
        times, rows = sheet.numbers("time_s"), sheet.rows
        sheet.problems.raise_if_any()
    else:
        raw = read_raw(path)
        if "time_s" not in raw.arrays:
            return None
        check = Checker(raw, str(path))
        times = check.real("time_s", (), (None,))
        check.problems.raise_if_any()
        # One time for all places is a number without an axis.
        times = np.atleast_1d(np.asarray(times))
        rows = tuple(f"row {i}" for i in range(len(times)))
    assert times is not None
    if not np.isfinite(times).all():
        row = rows[int(np.argmin(np.isfinite(times)))]
        raise DataError(f"{path}, time_s, {row}: no number; expected seconds")
    return times


def _of_table(path: str | Path, moving: Sequence[End], columns: Mapping[str, object]) -> QueryPlaces:
    sheet, notes = sheet_of(path)
    chosen, guessed = choose(sheet, columns, only=GUESSED)
    sheet.problems.raise_if_any()
    by_end = {end: places(sheet, chosen, end) for end in ("", "rx_", "tx_")}
    sheet.problems.raise_if_any()
    rest = {end: where for end, where in by_end.items() if where is not None}
    ends: dict[End, Places] = {}
    for end in moving:
        named = f"{end}_" if f"{end}_" in rest else ""
        # Coordinates without a name are taken once: a second end without its own is missing.
        if named not in rest or (len(moving) > 1 and not named and "" in ends):
            raise DataError(_missing(sheet, end, len(moving) > 1))
        ends[end] = rest.pop(named)
    # Static ends stand where they were measured: a query cannot move them.
    other = [f"of the {ENDS[end]}" for end in ENDS if f"{end}_" in rest] + ["without a name"] * ("" in rest)
    if other:
        guessed.append(f"not used: coordinates {' and '.join(other)}; that end is where it was measured")
    station = _words(sheet, chosen, "station")
    plain = None if station is None else sheet.words(chosen["station"][0].head or "")
    sheet.problems.raise_if_any()
    name = sheet.words(chosen["row_name"][0].head or "") if "row_name" in chosen else None
    # Columns that were read as one quantity; joined stations are several columns and stay as text.
    role = {columns[0].head: role for role, columns in chosen.items() if len(columns) == 1}
    table = tuple((head, role.get(head), sheet.words(head)) for head in sheet.heads if head)
    return _checked(QueryPlaces(str(path), ends, sheet.rows, station, plain, name, (*notes, *guessed), table))


def _missing(sheet: Sheet, end: End, both: bool) -> str:
    axes = "columns.latitude=COLUMN and .longitude, or .x and .y"
    axes = f"columns.{end}_x=COLUMN and .{end}_y" if both else axes
    return f"{sheet.source}: no coordinates of the {ENDS[end]} among {sheet.first_heads()}; say {axes}"


def _words(sheet: Sheet, chosen: Chosen, role: str) -> np.ndarray | None:
    if role not in chosen:
        return None
    head, words = chosen[role][0].head or "", sheet.joined(c.head for c in chosen[role])
    sheet.refuse_rows(head, np.flatnonzero(words == ""), f"no {role}; expected its name")
    return words


def _of_arrays(raw: Raw, source: str, moving: Sequence[End]) -> QueryPlaces:
    check = Checker(raw, source)
    by_end = {end: _end(check, end, alone=len(moving) == 1) for end in moving}
    check.problems.raise_if_any()
    ends: dict[End, Places] = {end: where for end, where in by_end.items() if where is not None}
    count = {end: len(where.across) for end, where in ends.items()}
    # A row asks about one link: both ends have a place in it.
    if len(set(count.values())) > 1:
        raise DataError(f"{source}: {count['tx']} places of the transmitter, {count['rx']} of the receiver")
    rows = tuple(f"row {i}" for i in range(next(iter(count.values()))))
    if not rows:
        raise DataError(f"{source}: no rows; expected a place or more")
    return _checked(QueryPlaces(source, ends, rows, _stations(raw, source, len(rows))))


def _end(check: Checker, end: End, alone: bool) -> Places | None:
    """Places (n,) of an end; those without its name are of the one that is `alone`."""
    # Unnamed arrays are taken only if one end moves, as they say nothing of which.
    position = check.given(f"{end}_position", *(("position",) if alone else ()))[:1]
    pair = check.given("latitude", "longitude") if alone else []
    if position and pair:
        fault = f"{position[0]} and {pair[0]} both say where; leave one out"
        return check.problems.add(check.source, fault)
    if len(pair) == 1 or not (position or pair):
        wanted = "latitude and longitude, or " if alone else ""
        fault = f"no places of the {ENDS[end]}; expected {wanted}{end}_position"
        return check.problems.add(check.source, fault)
    # Two columns are x and y without a height, which `with_heights` fills later.
    shapes = ((2,), (3,), (None, 2), (None, 3)) if position else ((), (None,))
    parts = [check.real(name, *shapes) for name in position or pair]
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    if len({part.shape for part in known}) > 1:
        both = " and ".join(str(part.shape) for part in known)
        fault = f"latitude and longitude have shapes {both}; expected one shape"
        return check.problems.add(check.source, fault)
    across = np.column_stack(known) if pair else np.atleast_2d(known[0])
    height = across[:, 2] if across.shape[1] == 3 else None
    for name in check.given(f"{end}_height", *(("height",) if alone else ())):
        # The third coordinate is the height; a second statement of it is not read.
        values = None if height is not None else check.real(name, (), (1,), (len(across),))
        height = height if values is None else np.broadcast_to(values, (len(across),))
    return Places(across[:, :2], height, bool(pair))


def _stations(raw: Raw, source: str, count: int) -> np.ndarray | None:
    station = raw.arrays.get("station")
    if station is None:
        return None
    station = station.reshape(-1)
    if len(station) != count or station.dtype.kind not in "iuUS":
        fault = f"found {station.dtype} of shape {raw.arrays['station'].shape}"
        raise DataError(f"{source}, station: expected {count} names or numbers, {fault}")
    names = raw.arrays.get("station_name")
    # Numbers refer to the file's own list, text to the model's names.
    if station.dtype.kind in "iu" and names is not None:
        wrong = np.flatnonzero((station < 0) | (station >= names.size))
        if len(wrong):
            fault = f"{station[wrong[0]]} is none of the {names.size} of station_name"
            raise DataError(f"{source}, station, row {wrong[0]}: {fault}")
        station = names.reshape(-1)[station]
    return station.astype(str)


def _checked(queries: QueryPlaces) -> QueryPlaces:
    """Refuse places with a coordinate that is not finite, and degrees that are not on Earth."""
    for end, where in queries.ends.items():
        names = ("latitude", "longitude", "height") if where.degrees else ("x", "y", "z")
        values = where.all()
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            row, axis = wrong[0]
            fault = f"{names[axis]} of the {ENDS[end]} is {values[row, axis]}; expected a finite number"
            raise DataError(f"{queries.source}, {queries.rows[row]}: {fault}")
        # On Earth before anything is projected: 91 degrees of latitude have finite metres too.
        off_earth = bad_degrees(*where.across.T) if where.degrees else None
        if off_earth is not None:
            raise DataError(f"{queries.source}, {queries.rows[off_earth[0]]}: {off_earth[1]}")
    return queries

"""Places that a model is asked about, from a table or from arrays: nothing measured is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.data.errors import DataError, Problems
from gsparc.data.own_checks import Checker
from gsparc.data.raw import Raw, read_raw
from gsparc.data.schema import ENDS, End
from gsparc.data.tables import is_table
from gsparc.data.tables.columns import Chosen, choose_columns
from gsparc.data.tables.heads import AXES
from gsparc.data.tables.opening import read_sheet
from gsparc.data.tables.places import Places, read_places
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
            return _of_sheet(*read_sheet(path), moving, columns)
        named = [name for name, value in columns.items() if value is not None]
        # Settings of columns have no meaning for named arrays, and would be ignored without a word.
        if named:
            raise DataError(f"columns.{named[0]}: goes with tables (*.csv, *.parquet), not with {path}")
        return replace(_of_sheet(_of_arrays(read_raw(path), str(path), moving), [], moving, {}), table=())
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
        sheet, _ = read_sheet(path)
    else:
        time_s = read_raw(path).arrays.get("time_s")
        sheet = _as_sheet(str(path), {} if time_s is None else {"time_s": time_s})
    if "time_s" not in sheet.heads:
        return None
    times = sheet.numbers("time_s")
    sheet.problems.raise_if_any()
    assert times is not None
    for row in np.flatnonzero(np.isnan(times)):
        raise DataError(f"{path}, time_s, {sheet.rows[row]}: no number; expected seconds")
    return times


def _of_sheet(
    sheet: Sheet, notes: list[str], moving: Sequence[End], columns: Mapping[str, object]
) -> QueryPlaces:
    chosen, guessed = choose_columns(sheet, columns, only=GUESSED)
    sheet.problems.raise_if_any()
    by_end = {end: read_places(sheet, chosen, end) for end in ("", "rx_", "tx_")}
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
    table = tuple((head, role.get(head), sheet.words(head)) for head in sheet.heads)
    return QueryPlaces(sheet.source, ends, sheet.rows, station, plain, name, (*notes, *guessed), table)


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


def _of_arrays(raw: Raw, source: str, moving: Sequence[End]) -> Sheet:
    """Arrays of places as columns of a table; where one end moves they need not name it."""
    check, columns, alone = Checker(raw, source), dict[str, np.ndarray | None](), len(moving) == 1
    pair = check.present("latitude", "longitude") if alone else []
    for end in moving:
        before, named = ("", True) if alone else (f"{end}_", False)
        position = check.present(f"{end}_position", *["position"] * named)[:1]
        if len(position) + len(pair) / 2 != 1:
            fault = f"{end}_position" + ", or latitude and longitude" * alone
            found = " and ".join([*position, *pair]) or "no places"
            raise DataError(f"{source}: of the {ENDS[end]} expected {fault}; found {found}")
        # Two columns are x and y without a height, which `with_heights` fills later.
        for name in position:
            places = check.read_real(name, (2,), (3,), (None, 2), (None, 3))
            axes = () if places is None else np.atleast_2d(places).T
            columns |= {f"{before}{axis}": values for axis, values in zip("xyz", axes, strict=False)}
        columns |= {name: check.read_real(name, (), (None,)) for name in pair}
        for name in check.present(f"{end}_height", *["height"] * named):
            if f"{before}z" not in columns:  # a second statement of it is not read
                columns[f"{before}z"] = check.read_real(name, (), (None,))
    check.problems.raise_if_any()
    station, names = raw.arrays.get("station"), raw.arrays.get("station_name")
    # Numbers refer to the file's own list, text to the model's names.
    if station is not None and names is not None and station.dtype.kind in "iu":
        wrong = np.flatnonzero((station < 0) | (station >= names.size))
        if len(wrong):
            fault = f"{station.flat[wrong[0]]} is none of the {names.size} of station_name"
            raise DataError(f"{source}, station, row {wrong[0]}: {fault}")
        station = names.reshape(-1)[station]
    return _as_sheet(source, columns if station is None else {**columns, "station": station.astype(str)})


def _as_sheet(source: str, columns: Mapping[str, np.ndarray | None]) -> Sheet:
    """A table of arrays (n,), or () of one value for all rows."""
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    count = next((len(values) for values in arrays.values() if values.ndim), 1)
    if not count:
        raise DataError(f"{source}: no rows; expected a place or more")
    for name, values in arrays.items():
        if values.shape not in ((), (count,)):
            raise DataError(f"{source}, {name}: expected {count} values, one a row, found {values.shape}")
    frame = pd.DataFrame({name: np.broadcast_to(values, count) for name, values in arrays.items()})
    return Sheet(source, frame, tuple(f"row {i}" for i in range(count)), problems=Problems(source))

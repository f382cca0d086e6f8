"""Places that a model is asked about, from a table: nothing measured is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.base.errors import DataError
from gsparc.data.schema import ENDS, End
from gsparc.tables.columns import choose_columns
from gsparc.tables.heads import AXES
from gsparc.tables.opening import read_sheet
from gsparc.tables.places import Places, read_ends
from gsparc.tables.raw import read_raw
from gsparc.tables.sheet import Sheet

# Only what a query needs: a column that looks like a level is none of its concern.
GUESSED = (*(f"{end}{axis}" for end in ("", "rx_", "tx_") for axis in AXES), "station", "device")


@dataclass(frozen=True)
class QueryPlaces:
    """Places in the order of their file.

    Attributes:
        source: the file, for messages.
        ends: places (n,) of each end that moves, as they were given.
        rows: (n,) what messages call each.
        station: (n,) names; None where the file names none.
        plain: (n,) the same without what several columns may add to them.
        device: (n,) names of devices, empty of none; None where no column names any.
        name: (n,) what a user calls each, where a column says so; else None.
        notes: what was guessed or not used, one line each.
        table: the columns of a table in order: head, quantity that was read out of it or None, text
            (n,).
    """

    source: str
    ends: dict[End, Places]
    rows: tuple[str, ...]
    station: np.ndarray | None = None
    plain: np.ndarray | None = None
    device: np.ndarray | None = None
    name: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    table: tuple[tuple[str, str | None, np.ndarray], ...] = ()

    def __len__(self) -> int:
        return len(self.rows)


def read_query_places(
    path: str | Path,
    moving: Sequence[End],
    columns: Mapping[str, object] = {},
    further: End | None = None,
) -> QueryPlaces:
    """Read places of the ends that move.

    Args:
        path: a table (*.csv, *.tsv, *.txt, *.parquet), or *.npz of `rx_position`, `tx_position`.
        moving: one end, or both.
        columns: of a table, by quantity, where the guess from their heads will not do.
        further: the other end, whose places are read too where no station is named.

    Raises:
        DataError: no file, no places, or a place that is none; the first problem, with row and
            column.
    """
    try:
        archive = Path(path).suffix.lower() == ".npz"
        return _of_sheet(
            _archive_sheet(path) if archive else read_sheet(path), moving, columns, further
        )
    except DataError as error:
        # Measurements are checked by `gsparc check`; places are not,
        # and here their settings are called so.
        first = error.problems[0].replace("dataset.columns", "columns")
        # The first problem alone: a table of queries is mostly wrong in the same way in every row.
        more = len(error.problems) - 1
        raise DataError(first + (f" (and {more} more)" if more else "")) from None


def read_times(path: str | Path) -> np.ndarray | None:
    """Read when (n,) [s] each place was visited, column `time_s`; None where there is none.

    Raises:
        DataError: no such file, or a time that is no number, with its row.
    """
    sheet = read_sheet(path)
    if "time_s" not in sheet.heads:
        return None
    times = sheet.numbers("time_s")
    if times is not None:
        sheet.refuse_rows("time_s", np.flatnonzero(np.isnan(times)), "no number; expected seconds")
    sheet.problems.raise_if_any()
    return times


def _archive_sheet(path: str | Path) -> Sheet:
    """Places of an archive as columns of a table."""
    arrays = read_raw(Path(path)).arrays
    places = {
        end: np.atleast_2d(arrays[f"{end}_position"]) for end in ENDS if f"{end}_position" in arrays
    }
    if not places:
        raise DataError(f"{path}: no rx_position or tx_position (n, 3) [m]")
    columns = {
        f"{end}_{axis}": pd.Series(values)
        for end, place in places.items()
        for axis, values in zip("xyz", place.T, strict=True)
    }
    frame = pd.DataFrame(columns).ffill()  # one place of an end goes with all of the other's
    return Sheet(str(path), frame, tuple(f"row {number}" for number in range(len(frame))))


def _of_sheet(
    sheet: Sheet, moving: Sequence[End], columns: Mapping[str, object], further: End | None
) -> QueryPlaces:
    settings = {key: value for key, value in columns.items() if value is not None}
    # A head that a table of measurements would not be taken at its word for
    if "device" in sheet.heads:
        settings.setdefault("device", "device")
    chosen = choose_columns(sheet, settings, only=GUESSED)
    sheet.problems.raise_if_any()
    rest = read_ends(sheet, chosen)
    sheet.problems.raise_if_any()
    ends: dict[End, Places] = {}
    for end in moving:
        named = f"{end}_" if f"{end}_" in rest else ""
        # Coordinates without a name are taken once: a second end without its own is missing.
        if named not in rest or (len(moving) > 1 and not named and "" in ends):
            axes = "columns.latitude=COLUMN and .longitude, or .x and .y"
            axes = f"columns.{end}_x=COLUMN and .{end}_y" if len(moving) > 1 else axes
            none = f"no coordinates of the {ENDS[end]} among {sheet.first_heads()}"
            raise DataError(f"{sheet.source}: {none}; say {axes}")
        ends[end] = rest.pop(named)
    if further is not None and f"{further}_" in rest and "station" not in chosen:
        ends[further] = rest.pop(f"{further}_")
    # Static ends stand where they were measured: a query cannot move them.
    other = [f"of the {ENDS[end]}" for end in ENDS if f"{end}_" in rest] + ["without a name"] * (
        "" in rest
    )
    if other:
        sheet.notes.append(
            f"not used: coordinates {' and '.join(other)}; that end is where it was measured"
        )
    several = [role for role in ("station", "device", "row_name") if role in chosen]
    joined = {role: sheet.joined(c.head for c in chosen[role]) for role in several}
    station, plain = joined.get("station"), None
    if station is not None:
        head = chosen["station"][0].head or ""
        plain = sheet.joined([head])
        sheet.refuse_rows(head, np.flatnonzero(station == ""), "no station; expected its name")
    sheet.problems.raise_if_any()

    # Columns that were read as one quantity; joined stations are several columns and stay as text.
    chosen.pop("device", None)
    role = {columns[0].head: role for role, columns in chosen.items() if len(columns) == 1}
    table = tuple((head, role.get(head), sheet.words(head)) for head in sheet.heads)
    return QueryPlaces(
        sheet.source,
        ends,
        sheet.rows,
        station,
        plain,
        joined.get("device"),
        joined.get("row_name"),
        tuple(sheet.notes),
        table,
    )

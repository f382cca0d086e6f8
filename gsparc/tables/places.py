"""Coordinates out of a table, and the one place of each station."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsparc.base.errors import Caution, DataError, list_first, name_row_ranges
from gsparc.data.georeference import find_invalid_coordinate
from gsparc.tables.column import BY_ROW, Chosen
from gsparc.tables.columns import choose_columns
from gsparc.tables.heads import AXES, ENDS, LISTS, OTHER_NAMES, words_of
from gsparc.tables.opening import read_sheet
from gsparc.tables.sheet import Sheet, say_column

UNKNOWN_HEIGHT = 0.0


@dataclass(frozen=True)
class Places:
    """Where something was.

    Attributes:
        across: (n, 2) float64, x and y [m], or latitude and longitude [deg].
        height: (n,) [m]; None where the table has none.
        degrees: which of the two `across` is.
    """

    across: np.ndarray
    height: np.ndarray | None
    degrees: bool

    @staticmethod
    def unknown(count: int, degrees: bool = False) -> Places:
        """Return so many that nobody knows."""
        return Places(np.full((count, 2), np.nan), np.full(count, np.nan), degrees)

    def all(self) -> np.ndarray:
        """Return (n, 2) or (n, 3)."""
        return self.across if self.height is None else np.column_stack([self.across, self.height])

    def take(self, rows: np.ndarray) -> Places:
        """Return those of some rows."""
        return Places(
            self.across[rows], None if self.height is None else self.height[rows], self.degrees
        )


def read_places(
    sheet: Sheet, chosen: Chosen, end: str, unknown: bool = False, strict: bool = True
) -> Places | None:
    """Read coordinates of an end (`rx_`, `tx_`, `station_`, or empty);
    None where the table has none.

    Where places may be `unknown`, rows without any coordinate are NaN; what is not on Earth is
    refused where it is `strict`, else left to `gsparc.tables.links.positions`.
    """
    for degrees, axes in ((False, ("x", "y")), (True, ("latitude", "longitude"))):
        roles = [f"{end}{axis}" for axis in axes]
        present = [role for role in roles if role in chosen]
        if not present:
            continue
        if len(present) == 1:
            missing = next(role for role in roles if role not in chosen)
            fault = f"column {chosen[present[0]][0].head!r} is {present[0]}, and none is {missing}"
            return sheet.refuse(f"{fault}; say {say_column(missing, 'COLUMN')}")
        absent = np.zeros(len(sheet), bool)
        if unknown:
            present = [
                role for role in (*roles, f"{end}z") if role in chosen and chosen[role][0].head
            ]
            absent = np.all(
                [sheet.words(chosen[role][0].head or "") == "" for role in present], axis=0
            )
        columns = [_complete(sheet, chosen, role, absent) for role in roles]
        height = _complete(sheet, chosen, f"{end}z", absent) if f"{end}z" in chosen else None
        if columns[0] is None or columns[1] is None:
            return None
        across = np.stack([columns[0], columns[1]], axis=1)
        if degrees:
            _on_earth(sheet, chosen, roles, across, strict)
        return Places(across, height, degrees)
    return None


def read_ends(sheet: Sheet, chosen: Chosen, strict: bool = True) -> dict[str, Places]:
    """Read the coordinates that a table has of rows, `rx_` and `tx_`; see `read_places`."""
    read = {end: read_places(sheet, chosen, end, strict=strict) for end in ENDS[:-1]}
    return {end: where for end, where in read.items() if where is not None}


def drop_rows_without_place(sheet: Sheet, chosen: Chosen) -> Sheet:
    """Leave out rows in which a coordinate of an end is empty,
    as loggers write them between fixes.
    """
    lost = np.zeros(len(sheet), bool)
    for end in ENDS[:-1]:
        for pair in (("x", "y"), ("latitude", "longitude")):
            heads = [chosen[f"{end}{axis}"][0].head for axis in pair if f"{end}{axis}" in chosen]
            if len(heads) == 2 and None not in heads:
                lost |= np.any([sheet.words(head or "") == "" for head in heads], axis=0)
    if not lost.any() or lost.all():
        return sheet
    named = np.array(sheet.rows)
    remark = (
        f"{name_row_ranges(named[lost].tolist())}: no place; these {lost.sum()} of "
        f"{len(sheet)} rows are"
    )
    sheet.notes.append(Caution(f"{remark} left out"))
    frame = sheet.frame[~lost].reset_index(drop=True)
    return replace(sheet, frame=frame, rows=tuple(named[~lost].tolist()))


def place_by_row(path: str | Path, columns: Mapping[str, object], end: str) -> dict[str, object]:
    """Return `dataset.columns` that put rows of a table without places apart; empty: it has places.

    Args:
        path: of the table.
        columns: settings of the training.
        end: that moved, `tx` or `rx`.

    Raises:
        DataError: rows are of one station each, and no column of times says which are of one
            moment.
    """
    sheet = read_sheet(path)
    roles = [f"{before}{axis}" for before in ENDS[:-1] for axis in AXES]
    settings = {key: value for key, value in columns.items() if OTHER_NAMES.get(key, key) in roles}
    heads_of_sheet = {key: head for key, head in settings.items() if head in sheet.heads}
    chosen = choose_columns(sheet, heads_of_sheet, {}, [*roles, "station"])
    if any(role in chosen for role in roles):
        return {}
    row_key = BY_ROW
    if "station" in chosen:
        row_key += BY_ROW.join(
            _times(sheet, sheet.joined(column.head for column in chosen["station"]))
        )
    return {**dict.fromkeys(settings), f"{end}_x": row_key, f"{end}_y": row_key, f"{end}_z": 0}


def _times(sheet: Sheet, station: np.ndarray) -> list[str]:
    """Heads of the columns that tell which rows, of a station (S,) each, are of one moment,
    or DataError.
    """
    heads = [head for head in sheet.heads if LISTS["time"] & set(words_of(head))]
    fault = (
        f"{sheet.source}: no coordinates, and rows of one station each: which are of one moment?"
    )
    wanted = "expected a column of times, or one row a moment with a column of levels per station"
    if not heads:
        raise DataError(f"{fault} {wanted}")
    moment, named = sheet.joined(heads), list_first([*map(repr, heads)])
    links, moments = len({*zip(moment.tolist(), station.tolist(), strict=True)}), len(set(moment))
    alone, empty = moments == len(moment) and len(set(station)) > 1, int((moment == "").sum())
    # Clocks of whole seconds repeat now and then; those of days, or of each row, tell nothing.
    if empty or alone or 2 * links < len(moment):
        values = f"{named} has {moments} values in {len(moment)} rows, {empty} empty"
        raise DataError(f"{fault} {values}; {wanted}")
    return heads


def _complete(sheet: Sheet, chosen: Chosen, role: str, absent: np.ndarray) -> np.ndarray | None:
    column = chosen[role][0]
    values = column.numbers(sheet)
    if values is not None and (np.isnan(values) & ~absent).any():
        rows = np.flatnonzero(np.isnan(values) & ~absent)
        return sheet.refuse_rows(
            column.head, rows, f"no value; {role} is needed, or take the row out"
        )
    return values


def _notation(lat: np.ndarray, lon: np.ndarray) -> str | None:
    """What numbers (n,) that are no decimal degrees are instead; None: metres, it seems."""
    # ddmm.mmmm is about a hundred times the degrees; minutes, its last two whole digits,
    # are below 60.
    if (
        max(np.abs(lat).max() / 90, np.abs(lon).max() / 180) <= 100
        and (np.abs([lat, lon]) % 100 < 60).all()
    ):
        return (
            "degrees and minutes as NMEA writes them (ddmm.mmmm): 4811.98 is 48 + 11.98 / 60; "
            "convert them"
        )
    # Receivers store degrees as integers in units of 1e-7: 1e7 is one degree, 9e8 the pole.
    whole = np.abs(lat).min() >= 1e7 and np.abs(lat).max() <= 9e8 and np.abs(lon).max() <= 1.8e9
    return "degrees times ten million; divide them" if whole else None


def _on_earth(
    sheet: Sheet, chosen: Chosen, roles: list[str], across: np.ndarray, strict: bool
) -> None:
    outside = np.flatnonzero(np.abs(across[:, 0]) > 90)
    swapped = (np.abs(across[:, 1]) <= 90).all()
    heads = [chosen[role][0].head or "" for role in roles]
    # Where most rows are outside, the columns are no degrees; else these rows are faulty.
    if 2 * len(outside) > len(across) and not swapped:
        end = roles[0].removesuffix("latitude")
        metres = f"metres? say {say_column(f'{end}x', heads[1])} {say_column(f'{end}y', heads[0])}"
        fault = _notation(*across[np.isfinite(across).all(axis=1)].T) or metres
        example = f"{across[outside[0], 0]:.10g} in {sheet.rows[outside[0]]}"
        return sheet.refuse(
            f"columns {heads[0]!r} and {heads[1]!r} are no degrees ({example}): {fault}"
        )
    if strict and (wrong := find_invalid_coordinate(*np.nan_to_num(across).T)):
        sheet.refuse(f"{sheet.rows[wrong[0]]}: {wrong[1]}")
    return None


def place_per_station(
    sheet: Sheet, row_places: Places, station: np.ndarray, names: Sequence[str], ask: bool = False
) -> Places | None:
    """Return the place of each station, the same in all its rows; None, and noted, when it is not.

    Args:
        sheet: for the names of rows.
        row_places: (S,) places, one for each row.
        station: (S,) which station each row is of.
        names: of the stations.
        ask: say whether it is so, and note nothing.
    """
    values = row_places.all()
    fixed = (values[:, :2] != 0).any(axis=1)  # 0, 0 in some of a station's rows: no fix there
    # The station's first row with a fix, or its first row where none has one.
    first = np.array([int(np.argmax((station == t) * (1 + fixed))) for t in range(len(names))])
    moved = np.flatnonzero((values != values[first[station]]).any(axis=1) & fixed)
    if len(moved) == 0:
        return row_places.take(first)
    if not ask:
        row = moved[0]
        both = (first[station[row]], row)
        at = [f"at ({', '.join(f'{v:.10g}' for v in values[i])}) in {sheet.rows[i]}" for i in both]
        sheet.refuse(
            f"station {names[station[row]]!r} is {' and '.join(at)}; expected one place for each"
        )
    return None

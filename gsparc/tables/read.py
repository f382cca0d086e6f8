"""From a file that is a table to the named arrays of the schema."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from gsparc.base.errors import Caution, DataError, Problems, list_first
from gsparc.data.units import WATTS
from gsparc.tables import heads, places
from gsparc.tables.advice import advise
from gsparc.tables.builder import Builder
from gsparc.tables.columns import choose_columns, list_roles
from gsparc.tables.opening import read_sheet
from gsparc.tables.raw import Raw
from gsparc.tables.said_columns import columns_file_beside, read_columns
from gsparc.tables.sheet import Role, Said, Sheet, settle
from gsparc.tables.slots import unfold_slots, unfold_tones
from gsparc.tables.station_list import StationList, read_stations


def parse_table(
    path: str | Path,
    columns: Mapping[str, object] = {},
    stations_file: str | Path | None = None,
    stations: Collection[str] = (),
    guess: bool = False,
    columns_file: str | Path | None = None,
) -> Raw:
    """Read the arrays of a table; notes say what was guessed.

    Args:
        path: *.csv, *.tsv, *.txt or *.parquet.
        columns: column by quantity (`heads.KINDS`) where a guess will not do; a number stands for
            all rows, a pattern with a `*` or a list for a column per station.
        stations_file: a second table: name, x, y, z or latitude, longitude, height of each station.
        stations: names in place of such a list: where heads hold them, no others are levels.
        guess: whether the likeliest reading of what is open is taken, and noted.
        columns_file: that says what columns are (`read_columns`); None: the one beside the table,
            if somebody edited it.

    Raises:
        DataError: all questions and problems, with row and column.
    """
    sheet, listed = read_sheet(path), None
    if stations_file is not None:
        listed = read_stations(
            replace(read_sheet(stations_file, sheet.problems), notes=sheet.notes)
        )
        sheet.problems.raise_if_any()

    def build(said: Said) -> tuple[Raw | None, list[Role], tuple[str, ...]]:
        asked = list[Role]()
        fresh = replace(sheet, problems=Problems(path), notes=[*sheet.notes], asked=asked)
        fresh = replace(fresh, marks=Counter())
        raw = _build(fresh, said, listed, stations)
        return raw, asked, tuple(fresh.problems)

    said: dict[str, object] = {}
    about = columns_file_beside(path) if columns_file is None else Path(columns_file)
    if about is not None:
        said |= read_columns(about, sheet.heads)
        sheet.notes.append(f"columns are what {about} says")
    given = {key: value for key, value in columns.items() if value is not None}
    others = {heads.OTHER_NAMES.get(key, key) for key in given}
    said = {key: value for key, value in said.items() if key not in others} | given
    settled = settle(build, said, sheet.source)
    questions, raw = [role.question() for role in settled.asked], settled.raw
    if questions and not guess:
        raise DataError([f"{sheet.source}: {question}" for question in questions], path)
    roles = (*settled.asked, *raw.roles)
    notes = (*questions, *raw.notes)
    return replace(raw, notes=notes, said=settled.said, roles=roles, heads=sheet.heads)


def _build(
    sheet: Sheet, columns: Said, listed: StationList | None, stations: Collection[str]
) -> Raw | None:
    """The arrays; None where something is wrong, or open."""
    given, whole = columns, sheet
    sheet, columns = unfold_slots(sheet, columns)
    sheet = unfold_tones(sheet)
    # The list of stations comes before the columns:
    # heads that hold its names are levels of stations.
    labelled: dict[str, str] = {}
    if listed is not None:
        parts = {head: heads.station_in_head(head) for head in sheet.heads}
        listed, labelled = listed.match_heads(parts)
    elif stations:
        sheet, labelled = _name_levels(sheet, stations)
    chosen = choose_columns(sheet, columns, labelled)
    # Everything after this trusts the choice of columns, so its problems are raised alone.
    if sheet.problems:
        return None
    sheet = places.drop_rows_without_place(sheet, chosen)
    arrays = Builder(sheet, chosen, listed).build()
    if sheet.is_open():
        return None
    power = next((chosen[role][0] for role in heads.LEVELS if role in chosen), None)
    about = {}
    if power is not None and "rssi_db" in chosen:
        about["level_unit"] = power.schema_unit
    # A column that is scaled has the schema's unit.
    if (
        power is not None
        and power.unit is not None
        and power.unit.name in WATTS
        and not power.unit.times
    ):
        about["unit"] = power.unit.name

    def reads(said: Said) -> Raw | None:
        again = replace(whole, problems=Problems(sheet.source), notes=[], asked=[])
        return _build(again, {**given, **said}, listed, stations)

    explain = partial(advise, sheet, chosen, reads)
    roles = tuple(list_roles(sheet, chosen, given))
    return Raw(arrays, about, notes=tuple(sheet.notes), explain=explain, roles=roles)


def _name_levels(sheet: Sheet, stations: Collection[str]) -> tuple[Sheet, dict[str, str]]:
    """Return a table with levels of these stations alone, if heads name any,
    and names by these heads.
    """
    roles = {head: heads.parse_head(head).role for head in sheet.heads}
    free = [head for head, role in roles.items() if role in (*heads.LEVELS, "station", None)]
    parts = {head: (heads.station_in_head(head), head) for head in free}
    levels = {head: name for head, names in parts.items() for name in names if name in stations}
    others = [
        head for head in free if levels and head not in levels and roles[head] in heads.LEVELS
    ]
    if others:
        which = list_first([*map(repr, others)])
        sheet.notes.append(
            Caution(f"columns {which} are of no station that was measured, and not used")
        )
    frame = sheet.frame.drop(columns=others)
    # A single column is of no station by itself
    if len(levels) == 1 and "station" not in roles.values():
        frame = frame.assign(station=next(iter(levels.values())))
    return replace(sheet, frame=frame), levels

"""Which column holds which quantity: said by `dataset.columns`, else guessed from its head."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import replace
from itertools import groupby

import numpy as np

from gsparc.base.errors import Caution, list_first
from gsparc.data.units import SCHEMA, Unit, list_units
from gsparc.tables import heads
from gsparc.tables.asked_columns import (
    MEASURED,
    STATION,
    ask_amplitude_beside_phase,
    ask_floor,
    ask_ranks,
    ask_which,
    is_rank,
    take_wide_levels,
)
from gsparc.tables.column import (
    JOINED,
    Chosen,
    Column,
    find_pattern,
    name_all,
    name_block,
    note_columns,
    used_heads,
)
from gsparc.tables.heads import (
    CHANNELS,
    ENDS,
    KINDS,
    LISTS,
    POLAR,
    Head,
    unit_of,
    words_of,
)
from gsparc.tables.said_columns import columns_of_setting
from gsparc.tables.sheet import NONE, Answer, Role, Said, Sheet
from gsparc.tables.times import find_times

# Of each group one way of saying it: the measurement,
# and the place of each end in metres or degrees.
ONE_OF = (
    MEASURED,
    *(((f"{end}x", f"{end}y"), (f"{end}latitude", f"{end}longitude")) for end in ENDS),
)
LESS = LISTS["labels"] | LISTS["plain"]  # words that are no part of a name
MOST_SHOWN = 3  # values of a column
REPEATED = 4  # rows for each name of a column that may hold stations


def list_roles(sheet: Sheet, chosen: Chosen, said: Said) -> list[Role]:
    """Return what all columns are taken for, in the order of quantities; like ones as one."""
    roles, settings = [], {heads.OTHER_NAMES.get(key, key): way for key, way in said.items()}
    for quantity, columns in chosen.items():
        names = [column.head for column in columns if column.head]
        text = settings.get(quantity)
        if text is None and names:
            text = "+".join(names) if columns[0].label == JOINED else name_block(sheet, names)
        unit = columns[0].unit.name if columns[0].unit else columns[0].schema_unit
        unit = unit if KINDS[quantity] in SCHEMA else ""
        role = Role(tuple(names), quantity, columns[0].sure, unit, column=text)
        roles.append(replace(role, values=sheet.first_words(names, MOST_SHOWN)))
    rest = [head for head in sheet.heads if head not in used_heads(chosen)]
    for _, group in groupby(rest, lambda head: re.sub(r"\d+", "*", head)):
        names = [*group]
        role = Role(tuple(names), "", "usual", column=name_block(sheet, names))
        roles.append(replace(role, values=sheet.first_words(names, MOST_SHOWN)))
    return roles


def choose_columns(
    sheet: Sheet,
    settings: Mapping[str, object],
    labelled: Mapping[str, str] = {},
    only: Container[str] | None = None,
) -> Chosen:
    """Choose the columns of each quantity; what was guessed is noted.

    Args:
        sheet: the table.
        settings: heads, patterns with a `*` or numbers by quantity, as in `dataset.columns`.
        labelled: names of stations by heads of columns that are taken as their levels.
        only: quantities that are guessed; None: all.
    """
    chosen, settled = dict[str, tuple[Column, ...]](), set[str]()
    for key, value in settings.items():
        columns = () if value is None else columns_of_setting(sheet, key, value)
        # Settings come first: what is said needs no guess, and its column is not guessed again.
        if columns:
            chosen[columns[0].role] = tuple(replace(column, sure="said") for column in columns)
        elif value == NONE:
            settled.add(heads.OTHER_NAMES.get(key, key))
    if sheet.problems:
        return chosen
    chosen_heads = used_heads(chosen)
    guesses: dict[str, list[Column]] = {}
    for head in sheet.heads:
        meaning = heads.parse_head(head) if head not in chosen_heads else Head()
        if head not in chosen_heads and head in labelled:
            power = "rssi" if meaning.role == "rssi" else "rssi_db"
            meaning = Head(power, labelled[head], meaning.unit, "station", meaning.strange)
        role = meaning.role
        areas = heads.TOGETHER[meaning.word] if meaning.word in LISTS["beside"] else set()
        # `ci` is a cell identity only beside an area code: alone it may be a confidence interval.
        alone = bool(areas) and not any(areas & set(words_of(other)) for other in sheet.heads)
        # What was said of one way (metres) rules out guesses of another (degrees) for the same end.
        unasked = role in settled or (only is not None and role not in only)
        if not role or alone or unasked or _settled(role, chosen):
            continue
        if meaning.strange:
            expected = list_units(KINDS[role])
            sheet.refuse(f"[{meaning.strange}] is no known unit; expected one of {expected}", head)
        guesses.setdefault(role, []).append(Column(**vars(meaning), head=head))
    # First of all, as a second measurement is no second candidate for the first one.
    _one_way(sheet, guesses)
    for role, guess in guesses.items():
        # Columns whose head says less than others of the quantity count only
        # where there is nothing better.
        candidates = [column for column in guess if not column.less] or guess
        if role == "station":
            candidates = _finest(sheet, _identity(sheet, candidates, always=only is not None))
        tones = role in (*CHANNELS, *POLAR)  # of a row, or stations
        # With a column of stations a row is of one: several columns of levels would contradict it.
        one_each = tones or "station" not in {**chosen, **guesses}
        several = (
            role in heads.MANY
            and len(candidates) > 1
            and one_each
            and all(c.label for c in candidates)
        )
        # Columns of different words (`rssi_1`, `power_2`) are no family of stations.
        several &= len({column.word for column in candidates}) == 1
        several |= role == "station" and candidates[0].label == JOINED
        # Of axes one that states its unit says more than others.
        stated = [c for c in candidates if c.unit is not None and KINDS[role] == "length"]
        candidates = stated if len(stated) == 1 else candidates
        # A head spelt as in the schema is a statement, no guess.
        exact = [column for column in candidates if column.head == role]
        # `rssi_delta` or `predicted_rssi` are levels by their words and not what was received.
        doubted = role in heads.LEVELS and not several and len(candidates) == 1
        doubted = doubted and not _is_plain(candidates[0], labelled.values())
        if doubted or (len(candidates) > 1 and not several and not exact):
            ask_which(sheet, role, candidates)
            continue
        if several and role in heads.LEVELS and ask_ranks(sheet, role, candidates):
            continue
        if several and any(map(is_rank, candidates)):
            ask_which(sheet, role, candidates)
            continue
        chosen[role] = tuple(candidates) if several else tuple((exact or candidates)[:1])
        if not exact or several:
            sheet.notes.append(note_columns(chosen[role]))
    for column in (columns[0] for columns in chosen.values()):
        if not column.word and column.unit is not None and column.unit.changes:
            sheet.notes.append(_turned(column, column.unit))
    _one_unit(sheet, chosen)
    if only is None and not sheet.asked:
        take_wide_levels(sheet, chosen)
        ask_amplitude_beside_phase(sheet, chosen)
        if not {"z", "rx_z", "tx_z"} & {*chosen, *settled}:
            ask_floor(sheet, chosen)
    if (
        only is None
        and "time_s" not in {*chosen, *settled}
        and any(role in chosen for role in heads.MANY)
    ):
        timed = tuple(Column("time_s", head=head) for head in find_times(sheet, used_heads(chosen)))
        chosen |= {"time_s": timed} if timed else {}
    used = used_heads(chosen)
    unused = [repr(head) for head in sheet.heads if head not in used]
    if unused:
        timed = heads.SHEET["times"] * any(LISTS["time"] & set(words_of(head)) for head in unused)
        sheet.notes.append(
            f"not used: column{'s' * (len(unused) > 1)} {list_first(unused, 8)}{timed}"
        )
    return chosen


def _finest(sheet: Sheet, columns: list[Column]) -> list[Column]:
    """The first column that tells all stations apart that several do; all where none does."""
    count = len(set(sheet.joined(column.head for column in columns).tolist()))
    fine = [c for c in columns if len(set(sheet.joined([c.head]).tolist())) == count]
    return columns if columns[0].label == JOINED or len(columns) < 2 else fine[:1] or columns


def _identity(sheet: Sheet, candidates: list[Column], always: bool) -> list[Column]:
    """A station's column and those that tell it from others of its name,
    `always` or where some do.
    """
    for first in candidates:
        parts = heads.TOGETHER.get(first.word, set())
        bare = {head: set(words_of(head)) - LESS for head in sheet.heads if head != first.head}
        more = [head for head, words in bare.items() if words and words <= parts]
        if not parts or not all(column is first or column.head in more for column in candidates):
            continue
        columns = [first]
        for head in more:
            longer = [*columns, replace(first, head=head)]
            fewer, many = (
                len(set(sheet.joined(c.head for c in parts_of_name).tolist()))
                for parts_of_name in (columns, longer)
            )
            # A column that tells rows rather than stations apart has nearly as many values
            # as there are rows.
            if always or fewer < many <= len(sheet) // REPEATED:
                columns = longer
        return (
            columns if len(columns) == 1 else [replace(column, label=JOINED) for column in columns]
        )
    return candidates


def _settled(role: str, chosen: Chosen) -> bool:
    """Whether what was said leaves no room for a guess of `role`."""
    other = [way for ways in ONE_OF if role in sum(ways, ()) for way in ways if role not in way]
    return role in chosen or any(name in chosen for way in other for name in way)


def _one_way(sheet: Sheet, guesses: dict[str, list[Column]]) -> None:
    """Refuse several measurements (levels, powers, channels),
    and an end that has both metres and degrees.
    """
    for ways in ONE_OF:
        by_way = [[column for role in way for column in guesses.get(role, ())] for way in ways]
        by_way = [columns for columns in by_way if columns]
        if len(by_way) < 2:
            continue
        first = [
            replace(cols[0], head=find_pattern(cols)) if ways is MEASURED else cols[0]
            for cols in by_way
        ]
        which = " and ".join(map(name_all, by_way))
        fault = (
            f"{which} both say where: which is meant"
            if ways is not MEASURED
            else (f"{name_all(first)} are different measurements: which is meant")
        )
        answers = [
            Answer(
                {c.role: find_pattern([o for o in columns if o.role == c.role]) for c in columns}
            )
            for columns in by_way
        ]
        sheet.ask(fault, *answers)
        for role in sum(ways, ()):
            guesses.pop(role, None)


def _is_plain(column: Column, stations: Iterable[str]) -> bool:
    """Whether the head of a guessed column says a level and nothing beyond
    that it may be of a station.
    """
    absolute = column.unit is not None and column.unit.name != "dB"
    named = column.label in stations or re.fullmatch(r"\W*", column.label)
    plain = set(words_of(column.label)) <= LISTS["plain"] | {column.word}
    return bool(absolute or named or plain or STATION.search(column.label))


def _one_unit(sheet: Sheet, chosen: Chosen) -> None:
    """Refuse a column in another unit than the schema's beside one of its kind that says none."""
    for kind in SCHEMA:
        # Kinds rather than quantities: a position in mm
        # beside another axis without a unit mixes both.
        columns = [
            c for group in chosen.values() for c in group if c.head and KINDS[c.role] == kind
        ]
        turned = [c for c in columns if c.unit is not None and c.unit.changes and not c.unit.times]
        # To watts or milliwatts?
        silent = [c for c in columns if c.unit is None or c.unit.name == "dB"]
        if turned and silent and turned[0].unit is not None:
            other = silent[0].unit
            fault = f"{turned[0].head!r} is in {turned[0].unit.name}, {silent[0].head!r} "
            fault += "says no unit" if other is None else f"in {other.name} of nothing"
            plain = unit_of(silent[0].head or "")[0]
            sheet.refuse(f"{fault}; rename one, e.g. to '{plain} [{SCHEMA[kind]}]'")


def _turned(column: Column, unit: Unit) -> str:
    """What becomes of a column that a setting chose; a caution where its head says a unit, too."""
    factor, bare, wanted = unit.times, unit.name, column.schema_unit
    if not factor:
        return f"column {column.head!r}: {bare} turned into {wanted}"
    then = f", then {bare} (by its head) into {wanted}" if bare not in ("", wanted) else ""
    value = float(unit.convert(np.array(100.0)))
    note = f"column {column.head!r} times {factor}{then}: 100 in the file is {value:g} {wanted}"
    return Caution(note) if then else note


def rename_for_stations(column: Column) -> Column:
    """Return the same column of a list of stations, where ends need not be named."""
    axis = next((a for a in heads.AXES for end in ENDS if column.role == f"{end}{a}"), None)
    return column if axis is None else replace(column, role=f"station_{axis}")

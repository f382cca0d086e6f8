"""Columns whose heads do not say what they hold: taken, or asked."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import pandas as pd

from gsparc.base.errors import Caution
from gsparc.tables import heads
from gsparc.tables.column import (
    Chosen,
    Column,
    find_pattern,
    name_all,
    name_block,
    name_columns,
    note_columns,
    used_heads,
)
from gsparc.tables.heads import (
    CHANNELS,
    KINDS,
    LISTS,
    POLAR,
    unit_of,
    words_of,
)
from gsparc.tables.sheet import NONE, Answer, Sheet, say_column
from gsparc.tables.slots import ranked_names

MEASURED: tuple[tuple[str, ...], ...] = (*((name,) for name in heads.LEVELS), CHANNELS, POLAR)
_STATIONS = "|".join(sorted(heads.STATION_WORDS))
# A letter or a number that remains of a head names a station; a whole word says another quantity.
STATION = re.compile(
    rf"(?i)^[\W_]*(?:[a-z]|(?:ant|antenna|port|carrier|{_STATIONS})?[\W_]*\d+)[\W_]*$"
)
MOST_LOOKED_AT = 10_000  # rows, for columns that may be levels


MAC = re.compile(r"(?i)(?<![0-9a-f])(?:[0-9a-f]{2}[:-]){5}[0-9a-f]{2}(?![0-9a-f])")
# With a number behind the word: `AP1` is a station's levels, `ap` a column of their names.
NAMED = re.compile(rf"(?i)^[\W_]*({_STATIONS}|beam|ssb|mac)[\W_]*[a-z]?\d+[\W_]*$")


def take_wide_levels(sheet: Sheet, chosen: Chosen) -> None:
    """Take columns called like stations (`AP1`, `WAP001`, a MAC address) as their levels,
    where no head says another measurement; ask about columns that hold values like levels.
    """
    levels = chosen.get("rssi_db", ())
    measured = any(roles[0] in chosen for roles in MEASURED)
    used = used_heads(chosen)
    rest = [head for head in sheet.heads if head not in used]
    named = [head for head in rest if MAC.search(head) or NAMED.match(head)]
    named = [head for head in named if _holds_numbers(sheet, head)]
    if named and "station" not in chosen and not measured:
        columns = (Column("rssi_db", head, head=head, word="station") for head in named)
        chosen["rssi_db"] = tuple(columns)
        return sheet.notes.append(note_columns(chosen["rssi_db"]))
    if sheet.asked is None or (measured and len(levels) < 2):
        return None
    span = BY_VALUE
    if measured:  # of the levels that are known
        numbers = sheet.frame[[c.head for c in levels]].apply(pd.to_numeric, errors="coerce")
        span = float(numbers.min(axis=None)), min(float(numbers.max(axis=None)), -1e-9)
    if not (alike := _like_levels(sheet, rest, span)):
        return None
    names, holds = name_columns(alike), "hold" if len(alike) > 1 else "holds"
    if measured:
        whole = [head for head in sheet.heads if head in {*alike, *(c.head for c in levels)}]
        how = say_column("rssi_db", name_block(sheet, whole))
        finding = f"{names} {holds} values like these levels and are not used: of stations, too?"
        return sheet.notes.append(Caution(f"{finding} {how}"))
    several = len(alike) > 1 and "station" not in chosen
    ways = [name_block(sheet, alike)] * several + alike[: MOST_READINGS - several]
    why = f"{names} {holds} values like levels, no head says so: which are"
    answers = [Answer({"rssi_db": way}, _means(sheet, way)) for way in ways]
    return sheet.ask(why, *answers, sure="seen")


def ask_ranks(sheet: Sheet, role: str, columns: Sequence[Column]) -> bool:
    """Ask whether numbers of levels are ranks, where columns beside them hold names; whether so."""
    parts = [(re.findall(r"\d+", column.label), column.head or "") for column in columns]
    if sheet.asked is None or any(len(numbers) != 1 for numbers, _ in parts):
        return False
    numbered = {numbers[0]: head for numbers, head in parts}
    if (names := ranked_names(sheet, numbered)) is None:
        return False
    levels = find_pattern([*columns])
    why = f"columns {names!r} hold names beside the levels of {levels!r}: are these the stations, "
    why += "or the numbers"
    block = name_block(sheet, [*numbered.values()])
    lists = Answer({role: levels, "station": names}, "lists of the strongest")
    sheet.ask(why, lists, Answer({role: block}, "a station each"), sure="seen")
    return True


def ask_amplitude_beside_phase(sheet: Sheet, chosen: Chosen) -> None:
    """Ask whether a level beside a phase is the amplitude of a channel."""
    levels = chosen.get("rssi_db", ())
    rest = [head for head in sheet.heads if head not in used_heads(chosen)]
    phases = [head for head in rest if words_of(unit_of(head)[0]) == ["phase"]]
    if sheet.asked is None or len(levels) != 1 or levels[0].sure == "said" or len(phases) != 1:
        return
    level, phase = levels[0].head or "", phases[0]
    why = (
        f"{name_columns([level, phase])} are level and phase: of a channel, or is the phase unused"
    )
    polar = Answer({"csi_amp": level, "csi_phase": phase}, "channels")
    sheet.ask(why, Answer({"rssi_db": level}, "levels"), polar, sure="seen")


STOREY_M = 3.2  # between floors, where nobody says more


def ask_floor(sheet: Sheet, chosen: Chosen) -> None:
    """Ask whether numbers of floors are heights or name groups of rows."""
    used = used_heads(chosen)
    for head in [head for head in sheet.heads if head not in used]:
        numbers = pd.to_numeric(pd.Series(sheet.words(head)), errors="coerce")
        words = {*words_of(head)} - LISTS["labels"]
        if words and words <= LISTS["floor"] and numbers.nunique() > 1:
            why = f"column {head!r} numbers floors: heights, or groups of rows"
            heights = Answer({"z": f"{head}*{STOREY_M:g}"}, f"heights, {STOREY_M:g} m each")
            group = Answer({"z": NONE, "run": head}, "groups of rows at one height")
            return sheet.ask(why, heights, group)
    return None


def _means(sheet: Sheet, way: object) -> str:
    single = isinstance(way, str) and way in sheet.heads
    return sheet.first_cell(str(way)) if single else "a station each"


def _holds_numbers(sheet: Sheet, head: str) -> bool:
    """Whether a column holds any number, or nothing: names of stations are no levels."""
    values = sheet.frame[head].dropna()
    return bool(pd.to_numeric(values, errors="coerce").notna().any() or (values == "").all())


BY_VALUE = (-140.0, -20.0)  # dBm, of columns that no head says to be levels


def _like_levels(sheet: Sheet, rest: Sequence[str], span: tuple[float, float]) -> list[str]:
    """Return which of heads hold numbers of a span [dB] but for one mark that repeats,
    and all that are called like one of them: of rarely heard stations, too.
    """
    alike, family = set[str](), {head: re.sub(r"\d+", "*", head) for head in rest}
    for head in rest:
        other = LISTS["no_level"] | LISTS["place"] | {*heads.AXIS_WORDS}
        if (other - LISTS["statistic"]) & set(words_of(head)):
            continue
        values = pd.to_numeric(sheet.frame[head].iloc[:MOST_LOOKED_AT], errors="coerce").dropna()
        inside = values.between(*span)
        if 2 * int(inside.sum()) > len(values) > 0 and values[~inside].nunique() < 2:
            alike.add(family[head])
    return [head for head in rest if family[head] in alike]


MOST_READINGS = 4  # of one question


def is_rank(column: Column) -> bool:
    """Whether what is left of a level's head says which of a list it is, and no station's name."""
    return bool({*words_of(column.label)} & LISTS["ranks"])


def ask_which(sheet: Sheet, role: str, columns: list[Column]) -> None:
    """Ask which of columns is a quantity, or of levels whether they are of a station each."""
    names = [column.head or "" for column in columns]
    ways: list[Any] = names[:MOST_READINGS]
    if role in heads.LEVELS and len(columns) > 1 and all(column.label for column in columns):
        block, ranks = name_block(sheet, names), any(map(is_rank, columns))
        ways = [*names[: MOST_READINGS - 1], block] if ranks else [block, *ways][:MOST_READINGS]
    ways += [NONE] if KINDS[role] == "length" else []
    why = f"{name_all(columns)} could each be {role}: which is it"
    if len(columns) == 1:
        why = f"{name_all(columns)}: a received level or power, or something else"
    sheet.ask(why, *(Answer({role: w}, "" if w == NONE else _means(sheet, w)) for w in ways))

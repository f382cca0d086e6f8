"""Which column holds which quantity: said by `dataset.columns`, else guessed from its head."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from gsparc.base.errors import Caution, list_first, suggest_name
from gsparc.data.units import SCHEMA, UNITS, Unit, list_units
from gsparc.tables import heads
from gsparc.tables.heads import (
    CHANNELS,
    ENDS,
    KINDS,
    LISTS,
    POLAR,
    Head,
    unit_of,
    unit_suits,
    words_of,
)
from gsparc.tables.roles import NONE, Answer, Role, Said, Sure, say_column
from gsparc.tables.sheet import Sheet
from gsparc.tables.slots import ranked_names
from gsparc.tables.times import find_times

MEASURED: tuple[tuple[str, ...], ...] = (*((name,) for name in heads.LEVELS), CHANNELS, POLAR)
# Of each group one way of saying it: the measurement,
# and the place of each end in metres or degrees.
ONE_OF = (
    MEASURED,
    *(((f"{end}x", f"{end}y"), (f"{end}latitude", f"{end}longitude")) for end in ENDS),
)
LESS = LISTS["labels"] | LISTS["plain"]  # words that are no part of a name
_STATIONS = "|".join(sorted(heads.STATION_WORDS))
# A letter or a number that remains of a head names a station; a whole word says another quantity.
STATION = re.compile(
    rf"(?i)^[\W_]*(?:[a-z]|(?:ant|antenna|port|carrier|{_STATIONS})?[\W_]*\d+)[\W_]*$"
)
MOST_LOOKED_AT = 10_000  # rows, for columns that may be levels
BY_ROW = "#"  # in place of a head: the number of the row; before heads: of what they hold together
MOST_SHOWN = 3  # values of a column
REPEATED = 4  # rows for each name of a column that may hold stations


@dataclass(frozen=True)
class Column(Head):
    """A column, or a number that stands for one.

    Attributes:
        head: of the column; None for a number.
        value: the number, or the first and the last of evenly spaced ones; none: the number of the
            row.
        plus: columns and numbers that are added to it.
        sure: how it is known that it is this.
        **rest: see `Head`; no unit is the schema's, no word a column that was said.
    """

    role: str = ""
    head: str | None = None
    value: tuple[float, ...] = ()
    plus: tuple[Column, ...] = ()
    sure: Sure = "named"

    @property
    def by_row(self) -> bool:
        """Whether it is the number of the row."""
        return self.head is None and not self.value

    @property
    def schema_unit(self) -> str:
        """Unit of its values once they are read."""
        unit, raw_unit = SCHEMA.get(KINDS[self.role], "deg"), self.unit
        if (raw_unit is None or not raw_unit.name) and "rsrp" in words_of(self.head or ""):
            return unit  # dBm by definition (3GPP TS 36.214)
        # Other levels of which nobody said more are in dB;
        # calling them dBm would invent a reference.
        relative = raw_unit is None or (
            raw_unit.name != "dBm" and (raw_unit.times or not raw_unit.changes)
        )
        return "dB" if unit == "dBm" and relative else unit

    def numbers(self, sheet: Sheet) -> np.ndarray | None:
        """Read (S,) float64 in the schema's unit, NaN: no value; None, and noted,
        where unusable.
        """
        if self.by_row:
            moments = sheet.joined(self.label.split(BY_ROW)) if self.label else np.array(sheet.rows)
            return pd.factorize(moments)[0].astype(float)
        if self.head is None:
            return np.full(len(sheet), self.value[0])
        if self.unit is not None and not unit_suits(self.role, self.unit):
            wanted = (
                f"one of {list_units(kind)}" if (kind := KINDS[self.role]) in SCHEMA else "no unit"
            )
            remedy = heads.PERCENT if self.unit.kind == "quality" else f"{self.role} needs {wanted}"
            return sheet.refuse(f"is in {self.unit.name}: {remedy}", self.head)
        marks = self.role == "rssi_db"
        values = sheet.numbers(
            self.head, self.unit, lambda unit: unit_suits(self.role, unit), marks
        )
        for other in self.plus:
            more = other.numbers(sheet)
            values = None if values is None or more is None else values + more
        return values


Chosen = dict[str, tuple[Column, ...]]


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


def used_heads(chosen: Chosen) -> set[str | None]:
    """Return the heads of all columns that are used."""
    columns = [column for group in chosen.values() for column in group]
    return {column.head for first in columns for column in (first, *first.plus)}


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
        columns = () if value is None else _by_setting(sheet, key, value)
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
            _ask_which(sheet, role, candidates)
            continue
        if several and role in heads.LEVELS and _ask_ranks(sheet, role, candidates):
            continue
        if several and any(map(_is_rank, candidates)):
            _ask_which(sheet, role, candidates)
            continue
        chosen[role] = tuple(candidates) if several else tuple((exact or candidates)[:1])
        if not exact or several:
            sheet.notes.append(_note(chosen[role]))
    for column in (columns[0] for columns in chosen.values()):
        if not column.word and column.unit is not None and column.unit.changes:
            sheet.notes.append(_turned(column, column.unit))
    _one_unit(sheet, chosen)
    if only is None and not sheet.asked:
        _wide_survey(sheet, chosen)
        _ask_phase(sheet, chosen)
        if not {"z", "rx_z", "tx_z"} & {*chosen, *settled}:
            _ask_floor(sheet, chosen)
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


JOINT = ("station", "device")
JOINED = "joined"  # label of columns whose values together name a station


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


MAC = re.compile(r"(?i)(?<![0-9a-f])(?:[0-9a-f]{2}[:-]){5}[0-9a-f]{2}(?![0-9a-f])")
# With a number behind the word: `AP1` is a station's levels, `ap` a column of their names.
NAMED = re.compile(rf"(?i)^[\W_]*({_STATIONS}|beam|ssb|mac)[\W_]*[a-z]?\d+[\W_]*$")


def _wide_survey(sheet: Sheet, chosen: Chosen) -> None:
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
        return sheet.notes.append(_note(chosen["rssi_db"]))
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


def name_block(sheet: Sheet, names: Sequence[str]) -> object:
    """Return what a setting calls several columns: the first and the last, or a list."""
    first = sheet.heads.index(names[0])
    if len(names) > 2 and sheet.heads[first : first + len(names)] == tuple(names):
        return f"{names[0]}...{names[-1]}"
    return [*names] if len(names) > 1 else names[0]


def _ask_ranks(sheet: Sheet, role: str, columns: Sequence[Column]) -> bool:
    """Ask whether numbers of levels are ranks, where columns beside them hold names; whether so."""
    parts = [(re.findall(r"\d+", column.label), column.head or "") for column in columns]
    if sheet.asked is None or any(len(numbers) != 1 for numbers, _ in parts):
        return False
    numbered = {numbers[0]: head for numbers, head in parts}
    if (names := ranked_names(sheet, numbered)) is None:
        return False
    levels = _pattern([*columns])
    why = f"columns {names!r} hold names beside the levels of {levels!r}: are these the stations, "
    why += "or the numbers"
    block = name_block(sheet, [*numbered.values()])
    lists = Answer({role: levels, "station": names}, "lists of the strongest")
    sheet.ask(why, lists, Answer({role: block}, "a station each"), sure="seen")
    return True


def _ask_phase(sheet: Sheet, chosen: Chosen) -> None:
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


def _ask_floor(sheet: Sheet, chosen: Chosen) -> None:
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


def _by_setting(sheet: Sheet, key: str, value: object) -> tuple[Column, ...]:
    role, where = heads.OTHER_NAMES.get(key, key), f"dataset.columns.{key}={value}"
    if role not in KINDS:
        hint = suggest_name(key, [*KINDS, *heads.OTHER_NAMES], 0.4) or (
            f"; known are {', '.join(KINDS)}"
        )
        return sheet.problems.add(where, f"no such quantity{hint}") or ()
    text = str(value).strip()
    if text.startswith(BY_ROW):  # before heads, whose words alone are compared
        return (Column(role, text.removeprefix(BY_ROW)),)
    if isinstance(value, Sequence) and not isinstance(value, str):  # of stations each
        listed = [column for text in value for column in _by_setting(sheet, key, text)]
        return tuple(replace(c, label=_label(c.head or "", role)) for c in listed)
    head = _head(sheet, text)
    if head is not None:
        return (Column(role, unit=_unit(head, role), head=head),)
    if text == NONE:
        return ()
    # After the head as it is: heads may hold a `*`, a `+` or a `-`.
    if KINDS[role] != "text" and (column := _sum_of_columns(sheet, role, text)) is not None:
        return (column,)
    joined = [_head(sheet, part.strip()) for part in text.split("+")] if role in JOINT else []
    if len(joined) > 1 and all(joined):
        return tuple(Column(role, JOINED, head=part) for part in joined)
    if role in heads.MANY and ("*" in text or "..." in text):
        times = re.fullmatch(r"(.*[^*].*)\*([-+]?\d*\.?\d+)", text)
        for pattern, factor in ((text, ""), times.groups() if times else ("", "")):
            if named := _named_columns(sheet, role, pattern):
                return tuple(_times(c, factor) for c in named) if factor else named
        fault = "expected one * only" if text.count("*") > 1 else "no column is called so"
        return sheet.problems.add(where, fault) or ()
    # `FIRST:LAST` of frequencies, or one number for all rows;
    # other text becomes NaN and no constant.
    numbers = tuple(pd.to_numeric(np.array(text.split(":"), object), errors="coerce").tolist())
    constant = all(map(math.isfinite, numbers)) and KINDS[role] != "text" and role not in heads.MANY
    if constant and len(numbers) <= (2 if role == "frequency_hz" else 1):
        return (Column(role, value=numbers),)
    hint = suggest_name(text, sheet.heads, 0.4) or f"; there are {sheet.first_heads()}"
    hint += f"; or say dataset.columns.{key}=null"
    return sheet.problems.add(where, f"{sheet.source} has no such column{hint}") or ()


def _named_columns(sheet: Sheet, role: str, text: str) -> tuple[Column, ...]:
    """Columns that a pattern with one `*` names, or FIRST...LAST; what is left names stations."""
    first, dots, last = (part.strip() for part in text.partition("..."))
    if dots and {first, last} <= {*sheet.heads}:
        begin, end = sheet.heads.index(first), sheet.heads.index(last)
        listed = sheet.heads[begin : end + 1]
        return tuple(Column(role, _label(h, role), _unit(h, role), head=h) for h in listed)
    matches = heads.match_pattern(text, sheet.heads)
    labels = {head: unit_of(part)[0].strip() for head, part in matches.items()}
    before, _, after = text.partition("*")
    # `MAC1` is a name, `RSSI_1` a level of the station 1.
    whole = role in heads.LEVELS and not LISTS["level"] & {*words_of(before + " " + after)}
    labels = {h: h if whole and label.isdigit() else label for h, label in labels.items()}
    return tuple(Column(role, label, _unit(h, role), head=h) for h, label in labels.items())


def _label(head: str, role: str) -> str:
    station = role in heads.LEVELS
    return heads.station_in_head(head) or head if station else heads.parse_head(head).label


def _sum_of_columns(sheet: Sheet, role: str, text: str) -> Column | None:
    """A column times a factor, as in `pathloss*-1`, with others and numbers: `asu*2-113`,
    `rssi-tx_power`.
    """
    for cut in [len(text), *(sign.start() for sign in re.finditer(r"[-+]", text))]:
        times = re.fullmatch(r"(.+)\*([-+]?\d*\.?\d+)", text[:cut].strip())
        head = _head(sheet, times[1].strip() if times else text[:cut].strip()) if cut else None
        if head is None:
            continue
        column, rest = Column(role, unit=_unit(head, role), head=head), text[cut + 1 :].strip()
        column = _times(column, times[2]) if times else column
        if cut == len(text):
            return column
        if re.fullmatch(r"\d*\.?\d+", rest):
            return replace(column, plus=(Column(role, value=(float(text[cut] + rest),)),))
        more = _sum_of_columns(sheet, role, rest)
        if more is not None:
            first = replace(more, plus=())
            first = _times(first, "-1") if text[cut] == "-" else first
            return replace(column, plus=(first, *more.plus))
    return None


def _times(column: Column, factor: str) -> Column:
    """The same times a number, or, where it already is, times -1."""
    unit = column.unit or Unit("", KINDS[column.role])
    multiplier = f"-{unit.times}" if unit.times else factor
    return replace(column, unit=replace(unit, times=multiplier, factor=unit.factor * float(factor)))


def _head(sheet: Sheet, text: str) -> str | None:
    """The column called `text`, else the only one called so but for case, spaces and unit."""
    if text in sheet.heads:
        return text
    words = words_of(text)
    # Case, spaces and a unit in brackets are layout; where two heads differ in them alone,
    # none is meant.
    alike = [h for h in sheet.heads if words and words in (words_of(h), words_of(unit_of(h)[0]))]
    return alike[0] if len(alike) == 1 else None


def _unit(head: str, role: str) -> Unit | None:
    unit, words = unit_of(head)[1], words_of(head)
    if (
        unit is None
        and len(words) > 1
        and words[-1] in UNITS
        and unit_suits(role, UNITS[words[-1]])
    ):
        return UNITS[words[-1]]
    # A level that is the amplitude of a channel
    return UNITS["db"] if unit is None and role == "csi_amp" and LISTS["level"] & {*words} else unit


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
            replace(cols[0], head=_pattern(cols)) if ways is MEASURED else cols[0]
            for cols in by_way
        ]
        which = " and ".join(map(_names, by_way))
        fault = (
            f"{which} both say where: which is meant"
            if ways is not MEASURED
            else (f"{_names(first)} are different measurements: which is meant")
        )
        answers = [
            Answer({c.role: _pattern([o for o in columns if o.role == c.role]) for c in columns})
            for columns in by_way
        ]
        sheet.ask(fault, *answers)
        for role in sum(ways, ()):
            guesses.pop(role, None)


def _pattern(columns: list[Column]) -> str | None:
    """A column's head, or what those of one quantity begin with, and a star."""
    names = [column.head or "" for column in columns if column.role == columns[0].role]
    return names[0] if len(names) == 1 else re.sub(r"\d+(?=\D*$)", "*", names[0])


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


MOST_READINGS = 4  # of one question


def _is_rank(column: Column) -> bool:
    """Whether what is left of a level's head says which of a list it is, and no station's name."""
    return bool({*words_of(column.label)} & LISTS["ranks"])


def _ask_which(sheet: Sheet, role: str, columns: list[Column]) -> None:
    """Ask which of columns is a quantity, or of levels whether they are of a station each."""
    names = [column.head or "" for column in columns]
    ways: list[Any] = names[:MOST_READINGS]
    if role in heads.LEVELS and len(columns) > 1 and all(column.label for column in columns):
        block, ranks = name_block(sheet, names), any(map(_is_rank, columns))
        ways = [*names[: MOST_READINGS - 1], block] if ranks else [block, *ways][:MOST_READINGS]
    ways += [NONE] if KINDS[role] == "length" else []
    why = f"{_names(columns)} could each be {role}: which is it"
    if len(columns) == 1:
        why = f"{_names(columns)}: a received level or power, or something else"
    sheet.ask(why, *(Answer({role: w}, "" if w == NONE else _means(sheet, w)) for w in ways))


def _names(columns: Iterable[Column]) -> str:
    return name_columns(column.head or "" for column in columns)


def name_columns(names: Iterable[str]) -> str:
    """Return heads for messages."""
    quoted = [*map(repr, names)]
    if len(quoted) > 4:
        quoted = [*quoted[:3], f"{len(quoted) - 3} more"]
    plural = f"columns {', '.join(quoted[:-1])} and {quoted[-1]}"
    return plural if len(quoted) > 1 else f"column {quoted[0]}"


def _note(columns: tuple[Column, ...]) -> str:
    first = columns[0]
    kind = KINDS[first.role]
    unit = f" [{first.schema_unit}]" if kind in SCHEMA else ""
    text = f"{_names(columns)} taken as {first.role}{unit}"
    if first.label == JOINED:
        return f"{text}: their values together name one"
    if len(columns) > 1:
        labels = [column.label for column in columns]
        of = "frequencies" if first.role in (*CHANNELS, *POLAR) else "stations"
        text += f" of the {of} {', '.join(labels[:3])}{', ...' if len(labels) > 3 else ''}"
        text += " (dBm? set unit=dBm)" if unit == " [dB]" else ""
    turned = first.unit is not None and first.unit.changes
    return text + (
        f", {first.unit.name} turned into {first.schema_unit}" if turned and first.unit else ""
    )


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

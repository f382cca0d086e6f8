"""Which column holds which quantity: said by `dataset.columns`, else guessed from its head."""

from __future__ import annotations

import difflib
import fnmatch
import math
import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gsparc.data.errors import some
from gsparc.data.tables.heads import (
    AXES,
    END_WORDS,
    ENDS,
    KINDS,
    MANY,
    OTHER_NAMES,
    SCHEMA,
    STATION_WORDS,
    UNITS,
    Head,
    Unit,
    known,
    suits,
    understand,
    unit_of,
    words_of,
)
from gsparc.data.tables.sheet import Sheet

LEVELS = ("rssi_db", "rssi")
CHANNELS = ("csi_re", "csi_im")
# Beside the word for a level: which radio, antenna or cell it is of.
PLAIN = {
    *("wifi", "wlan", "lte", "nr", "5g", "gsm", "umts", "ble", "bluetooth", "lora", "zigbee"),
    *("uwb", "serving"),
}
STATION = re.compile(
    r"(?i)^[\W_]*(?:[a-z]|(?:ant|antenna|port|carrier|" + "|".join(STATION_WORDS) + r")?[\W_]*\d+)[\W_]*$"
)
REPEATED = 4  # rows for each name of a column that may hold stations


@dataclass(frozen=True)
class Column:
    """A column, or a number that stands for one.

    Attributes:
        role: one of `heads.KINDS`.
        head: of the column; None for a number.
        label: name of a station or number of a frequency, where there are several.
        unit: None for the schema's.
        value: the number, or the first and the last of evenly spaced ones.
        word: what in the head was recognised; empty where the column was said.
    """

    role: str
    head: str | None
    label: str = ""
    unit: Unit | None = None
    value: tuple[float, ...] = ()
    word: str = ""

    def numbers(self, sheet: Sheet) -> np.ndarray | None:
        """(S,) float64 in the schema's unit, NaN where there is no value; None, and noted, where unusable."""
        if self.head is None:
            return np.full(len(sheet), self.value[0])
        if self.unit is not None and not suits(self.role, self.unit):
            kind = KINDS[self.role]
            wanted = f"one of {known(kind)}" if kind in SCHEMA else "no unit"
            return sheet.refuse(f"is in {self.unit.name}; {self.role} needs {wanted}", self.head)
        values = sheet.numbers(self.head)
        return values if values is None or self.unit is None else self.unit.convert(values)


Chosen = dict[str, tuple[Column, ...]]


def choose(
    sheet: Sheet, said: Mapping[str, object], labelled: Iterable[str] = (), only: Container[str] | None = None
) -> tuple[Chosen, list[str]]:
    """The columns of each quantity, and a note for each that was guessed.

    Args:
        sheet: the table.
        said: heads, patterns with a `*` or numbers by quantity, as in `dataset.columns`.
        labelled: names of stations; columns called so are taken as their levels.
        only: quantities that are guessed; None: all.
    """
    chosen: Chosen = {}
    labelled = set(labelled)
    for key, value in said.items():
        if value is not None:
            role = OTHER_NAMES.get(key, key)
            columns = _said(sheet, key, role, value)
            if columns:
                chosen[role] = columns
    if sheet.problems:
        return chosen, []
    taken = {column.head for columns in chosen.values() for column in columns}
    guesses: dict[str, list[Column]] = {}
    for head in sheet.heads:
        found = understand(head) if head and head not in taken else Head()
        if head not in taken and head in labelled:
            found = Head("rssi_db", label=head, word="station")
        if (
            found.role is None
            or (only is not None and found.role not in only)
            or _settled(found.role, chosen)
        ):
            continue
        if found.strange:
            sheet.refuse(
                f"[{found.strange}] is no known unit; expected one of {known(KINDS[found.role])}", head
            )
        guesses.setdefault(found.role, []).append(
            Column(found.role, head, found.label, found.unit, word=found.word)
        )
    _one_measurement(sheet, guesses)
    for end in ENDS:
        _one_system(sheet, guesses, end)
    notes = []
    for role, candidates in guesses.items():
        one_each = role in CHANNELS or "station" not in {**chosen, **guesses}  # of a row: tones, or stations
        several = role in MANY and len(candidates) > 1 and one_each
        several &= (
            all(column.label for column in candidates) and len({column.word for column in candidates}) == 1
        )
        exact = [column for column in candidates if column.head == role]
        if len(candidates) > 1 and not several and not exact:
            _ambiguous(sheet, role, candidates)
            continue
        if role in LEVELS and len(candidates) == 1 and not _is_plain(candidates[0], labelled):
            fault = "a received level or power, or something else? if it is one, say dataset.columns."
            sheet.refuse(f"{fault}{role}={candidates[0].head}", candidates[0].head or "")
            continue
        chosen[role] = tuple(candidates) if several else tuple((exact or candidates)[:1])
        if not exact:
            notes.append(_note(chosen[role]))
    for column in (columns[0] for columns in chosen.values()):
        if not column.word and column.unit is not None and column.unit.changes:
            notes.append(f"column {column.head!r}: {column.unit.name} turned into {schema_unit(column)}")
    _one_unit(sheet, chosen)
    used = {column.head for columns in chosen.values() for column in columns}
    unused = [repr(head) for head in sheet.heads if head and head not in used]
    if unused:
        notes.append(f"not used: column{'s' * (len(unused) > 1)} {some(unused, 8)}")
    if "station" not in chosen and not any(columns[0].label for columns in chosen.values()):
        notes += _perhaps_stations(sheet, used)
    return chosen, notes


def _perhaps_stations(sheet: Sheet, used: Container[str | None]) -> list[str]:
    """Columns that repeat few words and are called an end: without them all transmitters would be one."""
    found = []
    for head in (head for head in sheet.heads if head and head not in used):
        if not set(words_of(head)) & set(END_WORDS):
            continue
        distinct = len(set(sheet.words(head).tolist()) - {""})
        if 2 <= distinct <= len(sheet) // REPEATED:
            found.append(
                f"column {head!r} holds {distinct} names again and again: stations? say "
                f"dataset.columns.station={head!r}, with their places in dataset.stations_file"
            )
    return found


def _said(sheet: Sheet, key: str, role: str, value: object) -> tuple[Column, ...]:
    where = f"dataset.columns.{key}={value}"
    if role not in KINDS:
        close = difflib.get_close_matches(key, [*KINDS, *OTHER_NAMES], 1, 0.4)
        hint = f"; did you mean {close[0]}?" if close else f"; known are {', '.join(KINDS)}"
        return sheet.problems.add(where, f"no such quantity{hint}") or ()
    text = str(value).strip()
    head = _head(sheet, text)
    if head is not None:
        return (Column(role, head, unit=_unit(head, role)),)
    if "*" in text and role in MANY:
        heads = [h for h in sheet.heads if fnmatch.fnmatchcase(h, text)]
        before, _, after = text.partition("*")
        labels = [h[len(before) : len(h) - len(after)] for h in heads]
        if heads and "*" not in after:
            labels = [unit_of(label)[0].strip() for label in labels]
            pairs = zip(heads, labels, strict=True)
            return tuple(Column(role, h, label, _unit(h, role)) for h, label in pairs)
        fault = "expected one * only" if "*" in after else "no column is called so"
        return sheet.problems.add(where, fault) or ()
    numbers = tuple(_number(part) for part in text.split(":"))
    constant = all(map(math.isfinite, numbers)) and KINDS[role] != "text" and role not in MANY
    if constant and len(numbers) <= (2 if role == "frequency_hz" else 1):
        return (Column(role, None, value=numbers),)
    close = difflib.get_close_matches(text.lower(), [h.lower() for h in sheet.heads], 1, 0.4)
    near = next((h for h in sheet.heads if close and h.lower() == close[0]), None)
    there = ", ".join(repr(h) for h in sheet.heads[:8] if h)
    hint = f"; did you mean {near!r}?" if near else f"; there are {there}"
    return sheet.problems.add(where, f"{sheet.source} has no such column{hint}") or ()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _head(sheet: Sheet, text: str) -> str | None:
    """The column called `text`, else the only one called so but for case, spaces and unit."""
    if text in sheet.heads:
        return text
    words = words_of(text)
    alike = [h for h in sheet.heads if words and words in (words_of(h), words_of(unit_of(h)[0]))]
    return alike[0] if len(alike) == 1 else None


def _unit(head: str, role: str) -> Unit | None:
    unit, words = unit_of(head)[1], words_of(head)
    if unit is None and len(words) > 1 and words[-1] in UNITS and suits(role, UNITS[words[-1]]):
        return UNITS[words[-1]]
    return unit


def _settled(role: str, said: Chosen) -> bool:
    """Whether what was said leaves no room for a guess of `role`."""
    if role in said:
        return True
    measurements = (*LEVELS, *CHANNELS)
    if role in measurements and any(name in said for name in measurements):
        partner = {"csi_re": "csi_im", "csi_im": "csi_re"}.get(role)
        return partner not in said
    for end in ENDS:
        metres, degrees = _systems(end)
        for here, other in ((metres, degrees), (degrees, metres)):
            if role in here and any(name in said for name in other):
                return True
    return False


def _systems(end: str) -> tuple[tuple[str, str], tuple[str, str]]:
    return (f"{end}x", f"{end}y"), (f"{end}latitude", f"{end}longitude")


def _one_system(sheet: Sheet, guesses: dict[str, list[Column]], end: str) -> None:
    """Refuse an end that has both metres and degrees."""
    metres, degrees = ([c for r in roles for c in guesses.get(r, ())] for roles in _systems(end))
    if metres and degrees:
        fault = (
            f"{_names(metres)} and {_names(degrees)} both say where; say dataset.columns.{metres[0].role}="
        )
        fault += f"{metres[0].head} or dataset.columns.{degrees[0].role}={degrees[0].head}"
        sheet.refuse(fault)
        for column in (*metres, *degrees):
            guesses.pop(column.role, None)


def _one_measurement(sheet: Sheet, guesses: dict[str, list[Column]]) -> None:
    """Refuse columns of several measurements: levels and powers, or powers and channels."""
    found = [guesses[name] for name in (*LEVELS, "csi_re") if name in guesses]
    if len(found) < 2:
        return
    first = [columns[0] for columns in found]
    choices = " or ".join(f"dataset.columns.{c.role}={c.head}" for c in first)
    sheet.refuse(f"{_names(first)} are different measurements; say {choices}")
    for name in (*LEVELS, *CHANNELS):
        guesses.pop(name, None)


def _is_plain(column: Column, stations: Container[str]) -> bool:
    """Whether the head of a guessed column says a level and nothing beyond that it may be of a station."""
    absolute = column.unit is not None and column.unit.name != "dB"
    named = column.label in stations or re.fullmatch(r"\W*", column.label)
    return bool(absolute or named or set(words_of(column.label)) <= PLAIN or STATION.search(column.label))


def _one_unit(sheet: Sheet, chosen: Chosen) -> None:
    """Refuse a column in another unit than the schema's beside one of its kind that says none."""
    for kind in SCHEMA:
        columns = [c for one in chosen.values() for c in one if c.head and KINDS[c.role] == kind]
        turned = [c for c in columns if c.unit is not None and c.unit.changes]
        silent = [c for c in columns if c.unit is None or c.unit.name == "dB"]  # to watts or milliwatts?
        if turned and silent and turned[0].unit is not None:
            other = silent[0].unit
            said = f"{turned[0].head!r} is in {turned[0].unit.name}, {silent[0].head!r} "
            said += "says no unit" if other is None else f"in {other.name} of nothing"
            plain = unit_of(silent[0].head or "")[0]
            sheet.refuse(f"{said}; rename one, e.g. to '{plain} [{SCHEMA[kind]}]'")


def _ambiguous(sheet: Sheet, role: str, columns: list[Column]) -> None:
    choice = f"dataset.columns.{role}={columns[0].head}"
    stations = role in LEVELS and all(c.label for c in columns)
    more = f", or dataset.columns.{role}='NAME_*' where they are stations" if stations else ""
    sheet.refuse(f"{_names(columns)} could each be {role}; say which: {choice}{more}")


def _names(columns: Iterable[Column]) -> str:
    heads = [repr(column.head) for column in columns]
    if len(heads) > 4:
        heads = [*heads[:3], f"{len(heads) - 3} more"]
    plural = f"columns {', '.join(heads[:-1])} and {heads[-1]}"
    return plural if len(heads) > 1 else f"column {heads[0]}"


def _note(columns: tuple[Column, ...]) -> str:
    first = columns[0]
    kind = KINDS[first.role]
    unit = f" [{schema_unit(first)}]" if kind in SCHEMA else ""
    what = f"{_names(columns)} taken as {first.role}{unit}"
    if len(columns) > 1:
        labels = [column.label for column in columns]
        of = "frequencies" if first.role in CHANNELS else "stations"
        what += f" of the {of} {', '.join(labels[:3])}{', ...' if len(labels) > 3 else ''}"
    turned = first.unit is not None and first.unit.changes
    return what + (f", {first.unit.name} turned into {schema_unit(first)}" if turned and first.unit else "")


def schema_unit(column: Column) -> str:
    """Unit of the column's values once they are read."""
    unit = SCHEMA[KINDS[column.role]]
    return "dB" if unit == "dBm" and column.unit is not None and column.unit.name == "dB" else unit


def as_station(column: Column) -> Column:
    """The same column of a list of stations, where ends need not be named."""
    axis = next((a for a in AXES if column.role.endswith(a) and column.role not in KINDS_OF_ROWS), None)
    return column if axis is None else replace(column, role=f"station_{axis}")


KINDS_OF_ROWS = tuple(name for name, kind in KINDS.items() if kind not in ("length", "angle"))

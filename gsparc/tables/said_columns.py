"""Columns that a setting names: a head, a sum, a pattern, numbers; FILE.columns.yaml says what each
column of a table is taken for, to be read and changed by people.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from gsparc.base.errors import DataError, suggest_name
from gsparc.base.files import read_text
from gsparc.data.units import UNITS, Unit
from gsparc.tables import heads
from gsparc.tables.column import BY_ROW, JOINED, Column
from gsparc.tables.heads import (
    KINDS,
    LISTS,
    unit_of,
    unit_suits,
    words_of,
)
from gsparc.tables.sheet import NONE, Role, Said, Sheet

OPEN, UNUSED = "?", "unused"  # roles
ABOUT = """\
# What gsparc takes the columns of {file} for. Change a role (or a column, as dataset.columns takes
# it), and training follows. `?` is open: training stops, and says what it may be.
"""


def beside(path: str | Path) -> Path:
    """Return where the file about a table's columns is written."""
    return Path(f"{path}.columns.yaml")


def columns_file_beside(path: str | Path) -> Path | None:
    """Return the file about a table's columns beside it, where somebody edited it: it is taken."""
    return about if (about := beside(path)).is_file() and is_edited(about) else None


def hash_heads(heads: Sequence[str]) -> str:
    """Return a short hash of the heads of a table."""
    return hashlib.sha256("\n".join(heads).encode()).hexdigest()[:12]


def write_columns(path: str | Path, roles: Sequence[Role], heads: Sequence[str]) -> str:
    """Write what columns are taken for beside their table, unless somebody edited it;
    return one line that says so.
    """
    to = beside(path)
    if columns_file_beside(path):
        return f"{to} was edited, and is taken"
    asked = {name: role for role in roles for answer in role.readings for name in answer.said}
    lines = []
    for role in [role for role in roles if not role.readings]:
        name = OPEN if role.role in asked else role.role or UNUSED
        entry: dict[str, object] = {"column": role.column, "role": name}
        if role.role in asked:
            question = asked[role.role]
            may_be = [str(answer) for answer in question.readings]
            entry |= {"likely": role.role, "sure": question.sure, "may be": may_be}
        else:
            entry["sure"] = role.sure
        entry |= {"unit": role.unit} if role.unit else {}
        entry["values"] = [*role.values]
        text = yaml.safe_dump(entry, default_flow_style=True, width=10**6, sort_keys=False)
        lines.append(f"- {text}")
    body = ABOUT.format(file=Path(path).name) + f"heads: {hash_heads(heads)}\ncolumns:\n"
    body += "".join(lines)
    try:
        to.write_text(f"{body}written: {_hash(body)}\n", encoding="utf-8")
    except OSError as error:
        return f"{to}: cannot be written ({error.strerror or error})"
    return f"{to} says what each is taken for; change a role there, and training follows"


def _hash(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()[:12]


def is_edited(path: Path) -> bool:
    """Tell whether a file about columns is not as it was written."""
    body, _, written = path.read_text(encoding="utf-8").rpartition("written: ")
    return written.strip() != _hash(body)


def read_columns(path: Path, heads: Sequence[str]) -> Said:
    """Return columns by quantity, as a file about a table with these heads says;
    what it does not say is none, unless something in it is open.

    Raises:
        DataError: it is none, or the table has other heads.
    """
    try:
        content = yaml.safe_load(read_text(path, "no such file"))
        entries: list[Mapping[str, Any]] = [*content["columns"]]
        roles = [(str(entry["role"]), entry["column"]) for entry in entries]
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise DataError(f"{path}: no file about columns ({type(error).__name__})") from None
    if content.get("heads") != hash_heads(heads):
        raise DataError(f"{path}: the table's heads changed since; remove it, and check anew")
    for role, column in roles:
        if role not in (OPEN, UNUSED, *KINDS):
            raise DataError(
                f"{path}: {column}: {role!r} is no quantity; known are {', '.join(KINDS)}"
            )
    open_roles = any(role == OPEN for role, _ in roles)
    said: dict[str, object] = {} if open_roles else dict.fromkeys(KINDS, NONE)
    for role, column in roles:
        if role in KINDS:
            before = said.get(role, NONE)
            said[role] = column if before == NONE else f"{before}+{column}"
    return said


JOINT = ("station", "device")


def columns_of_setting(sheet: Sheet, key: str, value: object) -> tuple[Column, ...]:
    """Return the columns that a setting names; none, and noted, where there are no such ones."""
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
        listed = [column for text in value for column in columns_of_setting(sheet, key, text)]
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

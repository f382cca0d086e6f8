"""A table as it was written: heads, cells and what people call the rows; what its columns are taken
for, how surely, and what is asked where several readings fit.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from gsparc.base.errors import DataError, Problems, Question
from gsparc.tables.heads import PERCENT, SHEET, UNITS, Unit
from gsparc.tables.raw import Raw

# By a setting, a head, a documented default, values alone, or by nothing that decides
Sure = Literal["said", "named", "usual", "seen", "open"]
Said = Mapping[str, object]  # as `dataset.columns`
NONE = "none"  # in place of a head: no column is it


@dataclass(frozen=True)
class Answer:
    """A reading of a column.

    Attributes:
        said: what `dataset.columns` says then, by quantity.
        means: what it makes of the first row.
    """

    said: Said
    means: str = ""

    def __str__(self) -> str:
        settings = " ".join(say_column(role, value) for role, value in self.said.items())
        return f"{settings} ({self.means})" if self.means else settings


@dataclass(frozen=True)
class Role:
    """What columns are taken for.

    Attributes:
        heads: of the columns, as many as are read alike.
        role: quantity; empty: not used.
        sure: how it is known.
        unit: of the values as they are written.
        readings: that fit, the likeliest first; none where it is decided.
        why: what is open, for a question.
        column: the columns, as `dataset.columns` takes them.
        values: the first ones, as they are written.
    """

    heads: tuple[str, ...]
    role: str
    sure: Sure = "named"
    unit: str = ""
    readings: tuple[Answer, ...] = ()
    why: str = ""
    column: object = ""
    values: tuple[str, ...] = ()

    def question(self) -> Question:
        """Return one line: what is open, and the settings that answer it."""
        return Question(f"{self.why}? say {', or '.join(map(str, self.readings))}")


def say_quantity(role: str) -> str:
    """Return what settings call a quantity."""
    return role.replace("latitude", "lat").replace("longitude", "lon")


def say_column(role: str, text: object) -> str:
    """Return the setting that says what a column is, as a shell takes it.

    >>> print(say_column("rssi_db", "RSRP*-1"), say_column("station", "Cell id"))
    dataset.columns.rssi_db=RSRP*-1 'dataset.columns.station="Cell id"'
    >>> print(say_column("rssi_db", ["A", "B"]))
    'dataset.columns.rssi_db=["A","B"]'
    """
    name = say_quantity(role)
    if isinstance(text, list | tuple):
        listed = ",".join(f'"{head}"' for head in text)
        return f"'dataset.columns.{name}=[{listed}]'"
    plain = re.fullmatch(r"[\w.*+-]+", str(text))
    return f"dataset.columns.{name}={text}" if plain else f"'dataset.columns.{name}=\"{text}\"'"


@dataclass(frozen=True)
class Settled:
    """A table read with one answer to each question.

    Attributes:
        raw: its arrays.
        said: settings, answers included.
        asked: roles whose readings build different arrays, or that somebody has to confirm.
    """

    raw: Raw
    said: Said
    asked: tuple[Role, ...] = field(default=())


Build = Callable[[Said], tuple[Raw | None, list[Role], tuple[str, ...]]]


def settle(build: Build, said: Said, source: str, compare: bool = True) -> Settled:
    """Read a table with the likeliest reading of each open role that builds arrays.

    Args:
        build: its arrays, roles that are open, and what is wrong, where settings say so much.
        said: settings.
        source: for messages.
        compare: whether the other readings are tried, too; those that change nothing are not asked.

    Raises:
        DataError: what is wrong, after the questions that are open.
    """
    raw, asked, problems = build(said)
    if not asked:
        if raw is None:
            raise DataError(problems)
        return Settled(raw, said)
    role, read, faults = asked[0], list[tuple[Answer, Settled]](), list[str]()
    for answer in role.readings if compare else role.readings[:1]:
        try:
            more = {**said, **answer.said}
            read.append((answer, settle(build, more, source, compare and not read)))
        except DataError as error:
            faults = faults or [*error.problems]
    if not read:
        raise DataError([f"{source}: {role.question()}", *faults])
    first = read[0][1]
    unlike = [read[0][0]]
    for answer, settled in read[1:]:
        unlike += [] if are_alike(settled.raw, first.raw) else [answer]
    confirm = role.sure == "open" and len(role.readings) == 1
    own = (replace(role, readings=tuple(unlike)),) if confirm or len(unlike) > 1 else ()
    return replace(first, asked=own + first.asked)


def are_alike(first: Raw, other: Raw) -> bool:
    """Tell whether two readings have the same arrays."""
    return first.arrays.keys() == other.arrays.keys() and all(
        np.array_equal(array, other.arrays[name], equal_nan=array.dtype.kind in "fc")
        for name, array in first.arrays.items()
    )


NOT_HEARD = re.compile(SHEET["not_heard"])
REPEATS = 3
MEASURED = re.compile(r"\s*([-+]?\d*\.?\d+(?:e[-+]?\d+)?)\s*([a-zµμ%°]*)\s*", re.IGNORECASE)
SEXAGESIMAL = re.compile(
    r"\s*([nsew]?)\s*([-+]?)(\d{1,3}(?:\.\d+)?)(?:\s*[°º:d\s]\s*(?:(\d{1,2}(?:\.\d+)?)"
    r"(?:\s*['′’:m\s]\s*(?:(\d{1,2}(?:\.\d+)?)\s*(?:[\"″”s]|''|′′)?)?)?)?)?\s*([nsew]?)\s*",
    re.IGNORECASE,
)

MOVED = re.compile(r"[-+]?\d+(?:\.\d+){2,}")  # several points
INVISIBLE = "[\u200b-\u200d\u2060\ufeff]"  # spaces of no width, which names are pasted with
# 379.0 is 379: a name that a join of tables turned into a number
WHOLE = re.compile(r"^(\d+)\.0+$")


@dataclass(frozen=True)
class Sheet:
    """A rectangular table.

    Attributes:
        source: the file, for messages.
        frame: columns of text or of numbers by their heads, all different.
        rows: what a message calls each row: `line 2`, `row 0`.
        decimal: `.` or `,`, of numbers that are text.
        problems: takes what is wrong.
        marks: texts that stand for "not heard" among levels that were read, and how often each
            does.
        notes: how it was understood, for the user, one line each.
        asked: takes roles that are open; None: they are refused.
    """

    source: str
    frame: pd.DataFrame
    rows: tuple[str, ...]
    decimal: str = "."
    problems: Problems = field(default_factory=lambda: Problems(""))
    marks: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    asked: list[Role] | None = None

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def heads(self) -> tuple[str, ...]:
        """Heads of the columns."""
        return tuple(self.frame.columns)

    def first_heads(self) -> str:
        """Return the first heads, for messages."""
        return ", ".join(map(repr, self.heads[:8]))

    def describe_column(self, head: str) -> str:
        """Say how messages name a column."""
        return f"{self.source}, column {head!r}"

    def refuse(self, what: str, head: str | None = None) -> Any:
        """Note what is wrong with the table, or with a column; returns None."""
        return self.problems.add(self.source if head is None else self.describe_column(head), what)

    def ask(self, why: str, *answers: Answer, sure: Sure = "open") -> Any:
        """Note what is open, and the answers to it, the likeliest first; returns None."""
        role = Role((), next(iter(answers[0].said)), sure, readings=answers, why=why)
        if self.asked is None:
            return self.problems.append(f"{self.source}: {role.question()}")
        return self.asked.append(role)

    def is_open(self) -> bool:
        """Tell whether anything is wrong, or open, so that nothing further can be said."""
        return bool(self.problems or self.asked)

    def first_words(self, heads: Sequence[str], count: int) -> tuple[str, ...]:
        """Return the first cells of the first of columns."""
        return tuple(self.words(heads[0])[:count].tolist()) if heads else ()

    def first_cell(self, head: str) -> str:
        """Return the first value of a column, and where it stands, for messages."""
        rows = np.flatnonzero(self.words(head) != "")
        return f"{self.words(head)[rows[0]]} in {self.rows[rows[0]]}" if len(rows) else "empty"

    def refuse_rows(self, head: str | None, rows: np.ndarray, what: str) -> Any:
        """Note `what` for rows (n,) of a column; returns None."""
        return self.problems.add_rows(
            self.describe_column(head or ""), (self.rows[i] for i in rows), what
        )

    def words(self, head: str) -> np.ndarray:
        """Return text (S,) of a column, without surrounding spaces;
        empty where there is no value.
        """
        column = self.frame[head]
        missing = column.isna().to_numpy()
        if pd.api.types.is_float_dtype(column.dtype) and (column[~missing] % 1 == 0).all():
            column = column.astype("Int64")  # 212, not 212.0: a name that was read as a number
        texts = column.astype(str)
        if not texts[~missing].map(str.isascii).all():  # one name may be written in several ways
            texts = texts.str.normalize("NFC").str.replace(INVISIBLE, "", regex=True)
        text = texts.str.strip().to_numpy(dtype=object)
        empty = missing | np.isin(np.char.lower(text.astype(str)), SHEET["missing"])
        return np.where(empty, "", text).astype(str)

    def joined(self, heads: Iterable[str | None]) -> np.ndarray:
        """Return text (S,) of several columns together; empty where the first is."""
        parts = [[WHOLE.sub(r"\1", word) for word in self.words(head or "")] for head in heads]
        names = [" ".join(filter(None, row)) if row[0] else "" for row in zip(*parts, strict=True)]
        return np.array(names, dtype=str)

    def numbers(
        self,
        head: str,
        unit: Unit | None = None,
        suits: Callable[[Unit], bool] = lambda unit: False,
        levels: bool = False,
    ) -> np.ndarray | None:
        """Read (S,) float64 of a column, NaN for no value; None, and noted, where a cell is text.

        Args:
            head: of the column.
            unit: that its head says; values are in the schema's.
            suits: whether cells may hold a unit.
            levels: whether text that repeats may stand for "not heard": minus infinity.
        """
        column = self.frame[head]
        if pd.api.types.is_bool_dtype(column.dtype):
            return self.refuse("holds True and False; expected numbers", head)
        read: dict[str, float | None] = {}
        if pd.api.types.is_numeric_dtype(column.dtype):
            values = column.to_numpy(dtype=np.float64, na_value=np.nan)
            bad = (values == np.inf) | (np.isinf(values) & (not levels))
        else:
            cells = [str(cell) for cell in column]
            if self.decimal == ",":
                # A point in such a file is a second sort of mark, or stands between thousands:
                # refused.
                cells = ["x0" if "." in cell else cell.replace(",", ".") for cell in cells]
            values = pd.to_numeric(np.array(cells, dtype=object), errors="coerce").astype(
                np.float64
            )
            bad = ~np.isfinite(values)
            if bad.any():
                bad[bad] = self.words(head)[bad] != ""
                counts = Counter(cells[i] for i in np.flatnonzero(bad))
                before = len(self.problems)
                read = {
                    text: self._read(text, count * levels, suits, head)
                    for text, count in counts.items()
                }
                if len(self.problems) > before:
                    return None
        values = values if unit is None else unit.convert(values)
        if read:
            understood = [i for i in np.flatnonzero(bad) if read[cells[i]] is not None]
            values[understood] = [read[cells[i]] for i in understood]
            bad[understood] = False
        moved = [i for i in np.flatnonzero(bad) if MOVED.fullmatch(str(column.iloc[i]).strip())]
        if moved:
            first = f"{column.iloc[moved[0]]!r} in {self.rows[moved[0]]}"
            fault = f"{len(moved)} of {len(column)} cells hold several points, like {first}: a "
            fault += "spreadsheet took them for marks of thousands; export the column anew, as text"
            return self.refuse(fault, head)
        if bad.any():
            cells = column.astype(str).to_numpy(dtype=object)[bad]
            texts = (repr(cell if len(cell) <= 40 else cell[:37] + "...") for cell in cells)
            rows = (
                f"{self.rows[i]}: {cell}"
                for i, cell in zip(np.flatnonzero(bad), texts, strict=True)
            )
            mark = "commas" if self.decimal == "," else "points, and no marks between thousands"
            hint = (
                f"; this table has decimal {mark}"
                if any("," in c or "." in c for c in cells)
                else ""
            )
            fault = f"is no finite number{hint}; or leave it empty"
            return self.problems.add_rows(self.describe_column(head), rows, fault)
        return values

    def _read(
        self, text: str, count: int, suits: Callable[[Unit], bool], head: str
    ) -> float | None:
        """The number of a cell with a unit, or of degrees, minutes and seconds;
        None where it is none.

        Text that `count` cells of a level hold may stand for "not heard": minus infinity.
        """
        plain = text.strip().lower()
        # Any text without digits that repeats among levels stands for it,
        # others by their words alone.
        repeats = count >= REPEATS and (plain[:1] == "<" or not re.search(r"\d", plain))
        if count and (repeats or NOT_HEARD.fullmatch(plain)):
            self.marks[text.strip()] += count
            return -np.inf
        measured = MEASURED.fullmatch(text)
        unit = UNITS.get(measured[2].lower()) if measured and measured[2] else Unit("", "")
        if measured and unit is not None and (not measured[2] or suits(unit)):
            return float(unit.convert(np.array(float(measured[1]))))
        if measured and unit is not None and unit.kind == "quality" and suits(UNITS["dbm"]):
            fault = f"{self.describe_column(head)}: cells are in %: {PERCENT}"
            self.problems.extend([] if fault in self.problems else [fault])
            return np.nan  # said once, not of every row
        parts = SEXAGESIMAL.fullmatch(text) if suits(UNITS["deg"]) else None
        if parts is None:
            return None
        first, sign, *numbers, last = parts.groups()
        degrees = sum(float(number or 0) / 60**k for k, number in enumerate(numbers))
        return -degrees if sign == "-" or (first or last).lower() in ("s", "w") else degrees

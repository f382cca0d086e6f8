"""A column, or a number that stands for one, and what messages and settings call several."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from gsparc.data.units import SCHEMA, list_units
from gsparc.tables import heads
from gsparc.tables.heads import (
    CHANNELS,
    KINDS,
    POLAR,
    Head,
    unit_suits,
    words_of,
)
from gsparc.tables.sheet import Sheet, Sure

BY_ROW = "#"  # in place of a head: the number of the row; before heads: of what they hold together


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


def used_heads(chosen: Chosen) -> set[str | None]:
    """Return the heads of all columns that are used."""
    columns = [column for group in chosen.values() for column in group]
    return {column.head for first in columns for column in (first, *first.plus)}


JOINED = "joined"  # label of columns whose values together name a station


def name_block(sheet: Sheet, names: Sequence[str]) -> object:
    """Return what a setting calls several columns: the first and the last, or a list."""
    first = sheet.heads.index(names[0])
    if len(names) > 2 and sheet.heads[first : first + len(names)] == tuple(names):
        return f"{names[0]}...{names[-1]}"
    return [*names] if len(names) > 1 else names[0]


def find_pattern(columns: list[Column]) -> str | None:
    """A column's head, or what those of one quantity begin with, and a star."""
    names = [column.head or "" for column in columns if column.role == columns[0].role]
    return names[0] if len(names) == 1 else re.sub(r"\d+(?=\D*$)", "*", names[0])


def name_all(columns: Iterable[Column]) -> str:
    """Return the heads of columns for messages."""
    return name_columns(column.head or "" for column in columns)


def name_columns(names: Iterable[str]) -> str:
    """Return heads for messages."""
    quoted = [*map(repr, names)]
    if len(quoted) > 4:
        quoted = [*quoted[:3], f"{len(quoted) - 3} more"]
    plural = f"columns {', '.join(quoted[:-1])} and {quoted[-1]}"
    return plural if len(quoted) > 1 else f"column {quoted[0]}"


def note_columns(columns: tuple[Column, ...]) -> str:
    """Say what columns of one quantity were taken for."""
    first = columns[0]
    kind = KINDS[first.role]
    unit = f" [{first.schema_unit}]" if kind in SCHEMA else ""
    text = f"{name_all(columns)} taken as {first.role}{unit}"
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

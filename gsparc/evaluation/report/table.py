"""A table once, as CSV, Markdown or cells of a page."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gsparc.evaluation.report.intervals import Interval


@dataclass(frozen=True)
class Column:
    """A heading.

    Attributes:
        name: as shown, with its unit.
        form: how numbers are written.
        note: what it means, for a reader who points at it.
    """

    name: str
    form: str = ".4g"
    note: str = ""


@dataclass
class Table:
    """Rows under headings.

    Attributes:
        title: above it.
        columns: headings.
        rows: values: text, numbers, intervals or None.
        note: what to know before reading it.
    """

    title: str
    columns: Sequence[Column]
    rows: list[list[Any]] = field(default_factory=list)
    note: str = ""

    def add(self, *values: Any) -> None:
        """One row; `ValueError` when it does not fit the headings."""
        if len(values) != len(self.columns):
            raise ValueError(f"{self.title}: {len(values)} values under {len(self.columns)} headings")
        self.rows.append(list(values))

    def shown(self, value: Any, column: Column) -> str:
        """A cell as text."""
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return "–"
        if isinstance(value, Interval):
            return value.shown(column.form)
        return format(value, column.form) if isinstance(value, (int, float)) else str(value)

    @staticmethod
    def key(value: Any) -> str:
        """What a cell is sorted by."""
        value = value.value if isinstance(value, Interval) else value
        return "" if value is None else str(value)

    def csv(self) -> str:
        """Comma-separated, an interval as three columns."""
        spread = [any(isinstance(row[i], Interval) for row in self.rows) for i in range(len(self.columns))]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        heads: list[str] = []
        for column, wide in zip(self.columns, spread, strict=True):
            heads += [column.name, f"{column.name} low", f"{column.name} high"] if wide else [column.name]
        writer.writerow(heads)
        for row in self.rows:
            cells: list[Any] = []
            for value, wide in zip(row, spread, strict=True):
                one = value if isinstance(value, Interval) or not wide else Interval(value)
                cells += [one.value, one.low, one.high] if isinstance(one, Interval) else [one]
            writer.writerow(["" if cell is None else cell for cell in cells])
        return out.getvalue()

    def markdown(self) -> str:
        """A Markdown table under its title."""
        heads = [column.name for column in self.columns]
        lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        for row in self.rows:
            cells = [self.shown(v, c).replace("|", "\\|") for v, c in zip(row, self.columns, strict=True)]
            lines.append(f"| {' | '.join(cells)} |")
        note = f"\n{self.note}\n" if self.note else ""
        return f"### {self.title}\n{note}\n" + "\n".join(lines) + "\n"

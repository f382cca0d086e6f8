"""A table once: values under headings, as a console shows them, in Markdown,
as CSV or as cells of a page.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.table import Table as RichTable

from gsparc.evaluation.metric_formats import heading_of, number_format

Row = Mapping[str, Any]  # of results, see `results.result_rows`


@dataclass(frozen=True)
class Interval:
    """A value and its interval.

    Attributes:
        value: the figure.
        low, high: ends of the interval; None when unknown.
        error: standard deviation or error that is shown instead.
    """

    value: float
    low: float | None = None
    high: float | None = None
    error: float | None = None

    @property
    def bars(self) -> list[list[float]]:
        """Lengths of error bars below and above, (2, 1)."""
        ends = (self.value if end is None else end for end in (self.low, self.high))
        return [
            [max(sign * (end - self.value), 0.0)] for sign, end in zip((-1, 1), ends, strict=True)
        ]

    def text(self, form: str = ".2f") -> str:
        """Return `29.08 [27.4, 30.6]`, or `29.08 ± 0.30`."""
        ends = (
            ""
            if self.low is None or self.high is None
            else (f" [{self.low:{form}}, {self.high:{form}}]")
        )
        error = "" if self.error is None or math.isnan(self.error) else f" ± {self.error:{form}}"
        return f"{to_text(self.value, form)}{ends}{error}"


@dataclass(frozen=True)
class Column:
    """A heading, and what stands below it.

    Attributes:
        name: as shown, with its unit.
        form: how numbers are written; empty of words, which are aligned left.
        note: what it means, for a reader who points at it.
        of: a result's value: a column of the results, or a function; unused where rows are given.
    """

    name: str
    form: str = ".4g"
    note: str = ""
    of: str | Callable[[Row], Any] = ""

    def value(self, row: Row) -> Any:
        """Return what a result has in this column: text, a number, an interval or None."""
        return row.get(self.of) if isinstance(self.of, str) else self.of(row)

    def text(self, value: Any) -> str:
        """Return a cell as text."""
        if isinstance(value, Interval):
            return value.text(self.form)
        return (
            to_text(value, self.form)
            if value is None or isinstance(value, (int, float))
            else str(value)
        )


# Of all tables of results; seconds are means over folds, each of which trains a model.
TRAIN = Column("train s/fold", ".3g", of="train_s")
CPU = Column("cpu s/fold", ".3g", of="train_cpu_s")
P50 = Column("query ms p50", ".3g", of="query_ms")
P95 = Column("p95", ".3g", of="query_p95_ms")


def value_with_error(name: str, error: str) -> Callable[[Row], Interval]:
    """Return what makes `value ± error` of two columns of the results."""
    return lambda row: Interval(row[name], error=row[error])


def figure_column(figure: str, note: str = "", of: str | Callable[[Row], Any] = "") -> Column:
    """Return the column of a figure of merit;
    `of` where results have it elsewhere than under its name.
    """
    return Column(heading_of(figure), number_format(figure), note, of or figure)


@dataclass
class Table:
    """Rows under headings.

    Attributes:
        title: above it.
        columns: headings.
        rows: values: text, numbers, intervals or None.
        note: what to know before reading it.
        bold: first cell of a row that is emphasised.
        ends: what `low` and `high` of intervals are called in CSV, where that is something else.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]] = field(default_factory=list)
    note: str = ""
    bold: str | None = None
    ends: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_rows(
        cls, title: str, columns: Sequence[Column], results: Iterable[Row], **more: Any
    ) -> Table:
        """Return a row per result; `more` are `note` and `bold`."""
        return cls(
            title, columns, [[column.value(row) for column in columns] for row in results], **more
        )

    def without(self, *names: str) -> Table:
        """Return the same but for some columns."""
        indices = [i for i, column in enumerate(self.columns) if column.name not in names]
        rows = [[row[i] for i in indices] for row in self.rows]
        return replace(self, columns=[self.columns[i] for i in indices], rows=rows)

    @staticmethod
    def key(value: Any) -> str:
        """Return what a cell is sorted by."""
        value = getattr(value, "value", value)
        return "" if value is None else str(value)

    def texts(self) -> tuple[list[str], list[list[str]]]:
        """Return heads and cells as text."""
        rows = [
            [c.text(value) for c, value in zip(self.columns, row, strict=True)] for row in self.rows
        ]
        return [column.name for column in self.columns], rows

    def csv(self) -> str:
        """Return it comma-separated, an interval as a column for each part that it has."""
        parts: dict[str, list[Any]] = {}
        for number, column in enumerate(self.columns):
            cells = [row[number] for row in self.rows]
            parts[column.name] = [getattr(cell, "value", cell) for cell in cells]
            if any(isinstance(cell, Interval) for cell in cells):
                for end in ("low", "high", "error"):
                    ends = [getattr(cell, end, None) for cell in cells]
                    has_end = any(end_value is not None for end_value in ends)
                    parts |= {f"{column.name} {self.ends.get(end, end)}": ends} if has_end else {}
        # object: pandas would write whole numbers beside empty cells as 3.0.
        return pd.DataFrame(parts, dtype=object).to_csv(index=False, lineterminator="\n")

    def markdown(self) -> str:
        """Return a Markdown table under its title."""
        heads, rows = self.texts()
        # A bar inside a cell would end it.
        rows = [[cell.replace("|", "\\|") for cell in row] for row in rows]
        rows = [[f"**{cell}**" for cell in row] if row[0] == self.bold else row for row in rows]
        rule = (
            "|---"
            + "".join("|---:" if column.form else "|---" for column in self.columns[1:])
            + "|"
        )
        first, *lines = (f"| {' | '.join(cells)} |" for cells in (heads, *rows))
        note = f"\n{self.note}\n" if self.note else ""
        return f"### {self.title}\n{note}\n" + "\n".join([first, rule, *lines]) + "\n"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RichTable]:
        """Yield what a console shows: no column of dashes,
        and words whole where it is wide enough for them.

        Words are broken where they are wider than it, never cut.
        """
        heads, rows = self.texts()
        indices = [i for i in range(len(heads)) if not rows or any(row[i] != "-" for row in rows)]
        least = {i: _longest_word(heads[i], (row[i] for row in rows)) for i in indices}
        fits = sum(least.values()) + RULE * len(indices) < options.max_width
        natural = sum(max(map(cell_len, (heads[i], *(row[i] for row in rows)))) for i in indices)
        narrow = fits and natural + RULE * len(indices) >= options.max_width
        result = RichTable(title=self.title, caption=self.note or None)
        for i in indices:
            cells = max((cell_len(row[i]) for row in rows), default=0)
            # Words leave room to heads, numbers are as wide as they are.
            head = wrap_head(heads[i], max(least[i], cells if self.columns[i].form else 0))
            result.add_column(
                head if narrow else heads[i],
                justify="right" if self.columns[i].form else "left",
                overflow="fold",
                min_width=least[i] if narrow else None,
            )
        for row in rows:
            result.add_row(
                *(row[i] for i in indices), style="bold" if row[0] == self.bold else None
            )
        yield result


HEAD_PART = re.compile(r"[^ _]+_?")
RULE = 3  # characters beside each cell: two spaces and a line


def _longest_word(head: str, cells: Iterable[str]) -> int:
    return max(map(cell_len, [*HEAD_PART.findall(head), *" ".join(cells).split()]), default=0)


def wrap_head(head: str, width: int) -> str:
    """Return a heading in lines of some characters, broken behind spaces and underscores.

    >>> wrap_head("reduced_chi2", 8)
    'reduced_\\nchi2'
    """
    lines = [""]
    for part in re.findall(r"[^ _]+[ _]?", head):
        if lines[-1] and cell_len(lines[-1] + part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def to_text(value: float | None, form: str) -> str:
    """Return a number in a format, or a dash where there is none or NaN."""
    return "-" if value is None or math.isnan(value) else format(value, form)

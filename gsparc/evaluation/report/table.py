"""Figures with their uncertainty, and a table once: as CSV, Markdown or cells of a page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from gsparc.evaluation.summary import markdown_table

# Quantiles at 2.5 % of 1000 draws rest on 25 of them: two digits of an interval.
DRAWS = 1000
LEVEL = 0.95
Row = Mapping[str, Any]  # of the results, with `setting` and `run`, see `Run.row`


@dataclass(frozen=True)
class Interval:
    """A value and its interval.

    Attributes:
        value: the figure.
        low, high: ends of the interval; None when unknown.
    """

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def bars(self) -> list[list[float]]:
        """Lengths of error bars below and above, (2, 1)."""
        ends = (self.value if end is None else end for end in (self.low, self.high))
        return [[max(sign * (end - self.value), 0.0)] for sign, end in zip((-1, 1), ends, strict=True)]

    def text(self, form: str = ".2f") -> str:
        """`29.08 [27.4, 30.6]`."""
        ends = "" if self.low is None or self.high is None else f" [{self.low:{form}}, {self.high:{form}}]"
        return f"{self.value:{form}}{ends}"


def bootstrap(values: np.ndarray, weights: np.ndarray | None = None, seed: int = 0) -> tuple[float, float]:
    """Ends of the 95 % interval of a mean (n,), or of sum(values) / sum(weights), resampling samples.

    Samples are taken as independent; neighbours under `split=grouped` are not, so it is a lower bound.
    """
    # A fixed seed: the same run has the same interval in every report.
    draw = np.random.default_rng(seed).integers(0, len(values), (DRAWS, len(values)))
    below = np.ones_like(values) if weights is None else weights
    # 1e-300: a draw of silent rows alone has no power to divide by.
    means = values[draw].sum(1) / np.maximum(below[draw].sum(1), 1e-300)
    tail = (1 - LEVEL) / 2
    return float(np.quantile(means, tail)), float(np.quantile(means, 1 - tail))


def interval(row: Row, figure: str) -> Interval | None:
    """Return a test figure of a row with its bootstrap interval over test samples, or None."""
    # Baselines have no samples of their own here, only figures.
    value, parts = row.get(figure), None if row["baseline"] else _parts(row["run"].samples, figure)
    if value is None:
        return None
    return Interval(value) if parts is None else Interval(value, *bootstrap(*parts))


def _parts(own: Mapping[str, np.ndarray], figure: str) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Per-sample numbers whose (weighted) mean is the figure."""
    # The ratio of sums, not a mean of ratios, which one silent row would decide.
    if figure == "nmse" and "error_power" in own and "target_power" in own:
        known = np.isfinite(own["error_power"])
        return own["error_power"][known], own["target_power"][known]
    values = own.get(figure)
    if values is None or values.dtype.kind != "f":
        return None
    values = values[np.isfinite(values)]
    return (values, None) if len(values) > 1 else None


def over_seeds(values: Sequence[float | None]) -> Interval | None:
    """Mean, least and largest over those seeds that have a value; None where none has."""
    known = [value for value in values if value is not None]
    # A single seed has no spread: no brackets.
    if len(known) < 2:
        return Interval(known[0]) if known else None
    return Interval(float(np.mean(known)), min(known), max(known))


@dataclass(frozen=True)
class Column:
    """A heading, and what stands below it.

    Attributes:
        name: as shown, with its unit.
        form: how numbers are written.
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
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return "–"
        if isinstance(value, Interval):
            return value.text(self.form)
        return format(value, self.form) if isinstance(value, (int, float)) else str(value)


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
    rows: Sequence[Sequence[Any]] = ()
    note: str = ""

    @classmethod
    def of(cls, title: str, columns: Sequence[Column], results: Iterable[Row], note: str = "") -> Table:
        """Return a row per result."""
        return cls(title, columns, [[column.value(row) for column in columns] for row in results], note)

    def without(self, *names: str) -> Table:
        """Return the same but for some columns."""
        kept = [i for i, column in enumerate(self.columns) if column.name not in names]
        rows = [[row[i] for i in kept] for row in self.rows]
        return Table(self.title, [self.columns[i] for i in kept], rows, self.note)

    @staticmethod
    def key(value: Any) -> str:
        """Return what a cell is sorted by."""
        value = getattr(value, "value", value)
        return "" if value is None else str(value)

    def csv(self) -> str:
        """Comma-separated, an interval as three columns."""
        parts: dict[str, list[Any]] = {}
        for number, column in enumerate(self.columns):
            cells = [row[number] for row in self.rows]
            parts[column.name] = [getattr(cell, "value", cell) for cell in cells]
            if any(isinstance(cell, Interval) for cell in cells):
                for end in ("low", "high"):
                    parts[f"{column.name} {end}"] = [getattr(cell, end, None) for cell in cells]
        # object: pandas would write whole numbers beside empty cells as 3.0.
        return pd.DataFrame(parts, dtype=object).to_csv(index=False, lineterminator="\n")

    def markdown(self) -> str:
        """Return a Markdown table under its title."""
        cells = [
            # A bar inside a cell would end it.
            [column.text(value).replace("|", "\\|") for column, value in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]
        lines = markdown_table([column.name for column in self.columns], cells)
        note = f"\n{self.note}\n" if self.note else ""
        return f"### {self.title}\n{note}\n" + "\n".join(lines) + "\n"

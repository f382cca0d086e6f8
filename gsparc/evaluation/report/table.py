"""Figures with their uncertainty, and a table once: as CSV, Markdown or cells of a page."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsparc.evaluation.report.runs import Run

DRAWS = 1000
LEVEL = 0.95


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

    def shown(self, form: str = ".2f") -> str:
        """`29.08 [27.4, 30.6]`."""
        ends = "" if self.low is None or self.high is None else f" [{self.low:{form}}, {self.high:{form}}]"
        return f"{self.value:{form}}{ends}"


def bootstrap(values: np.ndarray, weights: np.ndarray | None = None, seed: int = 0) -> tuple[float, float]:
    """Ends of the 95 % interval of a mean (n,), or of sum(values) / sum(weights), resampling samples.

    Samples are taken as independent; neighbours under `split=grouped` are not, so it is a lower bound.
    """
    draw = np.random.default_rng(seed).integers(0, len(values), (DRAWS, len(values)))
    below = np.ones_like(values) if weights is None else weights
    means = values[draw].sum(1) / np.maximum(below[draw].sum(1), 1e-300)
    tail = (1 - LEVEL) / 2
    return float(np.quantile(means, tail)), float(np.quantile(means, 1 - tail))


def interval(run: Run, figure: str) -> Interval | None:
    """A test figure of a run with its bootstrap interval over test samples; None without the figure."""
    value, parts = run.figure_of(figure), _parts(run, figure)
    if value is None:
        return None
    return Interval(value) if parts is None else Interval(value, *bootstrap(*parts))


def _parts(run: Run, figure: str) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Per-sample numbers whose (weighted) mean is the figure."""
    own = run.samples
    if figure == "nmse" and "error_power" in own and "target_power" in own:
        known = np.isfinite(own["error_power"])
        return own["error_power"][known], own["target_power"][known]
    found = own.get(figure)
    if found is None or found.dtype.kind != "f":
        return None
    found = found[np.isfinite(found)]
    return (found, None) if len(found) > 1 else None


def over_seeds(values: Sequence[float | None]) -> Interval | None:
    """Mean, least and largest over those seeds that have a value; None where none has."""
    known = [value for value in values if value is not None]
    if len(known) < 2:
        return Interval(known[0]) if known else None
    return Interval(float(np.mean(known)), min(known), max(known))


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

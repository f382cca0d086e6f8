"""How commands show results: tables on the console, figures that appear whole."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from rich.table import Table

from gsparc.data.files import whole_file


def run_directory() -> Path:
    """Where the running command writes."""
    return Path(HydraConfig.get().runtime.output_dir)


def table(title: str, words: Sequence[str], numbers: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table with columns of `words`, aligned left, before columns of `numbers`, aligned right."""
    found = Table(title=title)
    for column in (*words, *numbers):
        found.add_column(column, justify="left" if column in words else "right")
    for row in rows:
        found.add_row(*row)
    return found


def shown(value: float | None, form: str) -> str:
    """A number in a format, or a dash where there is none."""
    return "-" if value is None else format(value, form)


def columns(rows: Sequence[Any], of: type) -> dict[str, list[Any]]:
    """Columns of a CSV file from instances of the dataclass `of`; None becomes an empty cell."""
    values = {field.name: [getattr(row, field.name) for row in rows] for field in fields(of)}
    return {name: ["" if value is None else value for value in column] for name, column in values.items()}


def panels(
    width: float, height: float, rows: int = 1, columns: int = 1, **how: Any
) -> tuple[Figure, np.ndarray]:
    """A figure of `width` x `height` inches and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **how)


def logarithmic(axes: Any) -> None:
    """Horizontal axis in decades, with plain numbers also between them where there are few decades."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=110, format="png")

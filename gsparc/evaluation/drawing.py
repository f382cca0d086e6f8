"""What all figures share: axes on a canvas, logarithmic axes with plain numbers, files that appear whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from gsparc.data.files import whole_file


def panels(
    width: float, height: float, rows: int = 1, columns: int = 1, *, grid: bool = True, **how: Any
) -> tuple[Figure, np.ndarray]:
    """A figure of `width` x `height` inches and its axes (rows, columns), with grid lines."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **how)
    for one in axes.flat if grid else ():
        one.grid(alpha=0.3)
    return figure, axes


def logarithmic(axes: Any, fine: bool | None = None) -> None:
    """Horizontal axis in decades; plain numbers also between them if `fine`, None: where decades are few."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    fine = high < 1000 * low if fine is None else fine
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if fine else (1,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def save(figure: Figure, path: Path, dpi: float = 110) -> None:
    """Write a figure as PNG, atomically."""
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=dpi, format="png")

"""What all figures share: a style, a look per method, axes on a canvas, files that appear whole."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from gsparc.data.files import whole_file

# Colours that are told apart with any colour vision (Okabe and Ito 2008), the yellow made readable on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F", "#000000")
GREY = "#7F7F7F"
MARKS = "osD^vPX<>ph"
STYLE: dict[Any, Any] = {
    "axes.prop_cycle": cycler(color=PALETTE),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "figure.titlesize": "medium",
    "font.size": 10.0,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
}
# The same method looks the same everywhere; others get one by their name.
METHODS: dict[str, tuple[str, str]] = {
    "gsparc": ("#D55E00", "*"),
    "gp": ("#0072B2", "s"),
    "kriging": ("#56B4E9", "s"),
    "complex_gp": ("#0072B2", "D"),
    "idw": ("#009E73", "o"),
    "nearest": ("#009E73", "^"),
    "distance_law": ("#8C6D1F", "v"),
    "mean": (GREY, "o"),
    "zero": (GREY, "X"),
    "auto": ("#D55E00", "D"),
    "blind": ("#D55E00", "P"),
    "splat": ("#E69F00", "o"),
    "paper": ("#E69F00", "s"),
    "swiftwrf": ("#CC79A7", "o"),
    "wrfgs": ("#CC79A7", "s"),
    "gsrf": ("#CC79A7", "D"),
    "nerf2": ("#000000", "o"),
    "ngrf": ("#000000", "s"),
    "newrf": ("#000000", "D"),
}


def look(method: str) -> tuple[str, str]:
    """Colour and mark of a method."""
    number = zlib.crc32(method.encode())
    return METHODS.get(method, (PALETTE[number % len(PALETTE)], MARKS[number // 8 % len(MARKS)]))


def panels(
    width: float, height: float, rows: int = 1, columns: int = 1, *, grid: bool = True, **how: Any
) -> tuple[Figure, np.ndarray]:
    """A figure of `width` x `height` inches in our style and its axes (rows, columns), with grid lines.

    At most 9 inches of width stay readable at 600 pixels.
    """
    matplotlib.rcParams.update(STYLE)  # text and lines that are added later read it too
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

"""What all figures share: a style, a look per method, axes on a canvas, files that appear whole."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from gsparc.base.files import whole_file
from gsparc.base.limits import choice
from gsparc.evaluation.metric_formats import axis_of, lower_is_better

# Colours that are told apart with any colour vision (Okabe
# and Ito 2008, the yellow darker; Tol 2021).
PALETTE = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#4B5320",
    "#000000",
    "#882255",
    "#332288",
)
STROKES = ("-", "--", ":", "-.")  # where there are more lines than colours
GREY = "#6E6E6E"
STYLE: dict[Any, Any] = {
    "axes.prop_cycle": cycler(color=PALETTE),
    "axes.formatter.useoffset": False,  # 29.114 is read, 0.004 beside +2.911e1 is not
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "figure.titlesize": "medium",
    "font.size": 10.0,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
}


PRINTED = choice("pdf", "svg")  # formats beside PNG


class MethodStyle(NamedTuple):
    """How a method is drawn: colour, mark, whether it is the second
    of its colour (open, dashed).
    """

    colour: str
    mark: str
    second: bool = False

    @property
    def marked(self) -> dict[str, Any]:
        """For points joined by a line."""
        return {
            "marker": self.mark,
            "markerfacecolor": "w" if self.second else self.colour,
            **self.line,
        }

    @property
    def line(self) -> dict[str, Any]:
        """For a line without points."""
        return {"color": self.colour, "linestyle": "--" if self.second else "-"}


# The same method looks the same everywhere; of two drawn together in one colour one is the second.
METHODS = {
    "gsparc": MethodStyle("#D55E00", "*"),
    "blind": MethodStyle("#D55E00", "P", True),
    "gp": MethodStyle("#0072B2", "s"),
    "complex_gp": MethodStyle("#0072B2", "D", True),
    "idw": MethodStyle("#009E73", "o"),
    "calibrated_raytracer": MethodStyle("#009E73", "v", True),
    "swiftwrf": MethodStyle("#CC79A7", "X"),
    "distance_law": MethodStyle("#CC79A7", "v"),
    "newrf": MethodStyle("#CC79A7", "^", True),
    "paper": MethodStyle("#E69F00", "s"),
    "gaussians": MethodStyle("#E69F00", "o", True),
    "kriging": MethodStyle("#56B4E9", "p"),
    "residual": MethodStyle("#56B4E9", "h", True),
    "wrfgs": MethodStyle("#4B5320", "D"),
    "array": MethodStyle("#4B5320", "X", True),
    "nerf2": MethodStyle("#000000", "o"),
    "image_source_gp": MethodStyle("#000000", "v"),
    "nearest": MethodStyle("#332288", "^"),
    "wideband": MethodStyle("#332288", "D", True),
    "gsrf": MethodStyle("#882255", "P"),
    "ngrf": MethodStyle("#882255", "s", True),
    "mean": MethodStyle(GREY, "o"),
    "zero": MethodStyle(GREY, "X", True),
}
OTHERS = "<>8H"  # marks of methods without an entry
TOGETHER = "_together"  # ends the name of a method that serves all stations at once
PUBLISHED = "full_size_"  # begins the name of one at its published size


def style_of(method: str) -> MethodStyle:
    """Return how a method is drawn; one without an entry by its name."""
    base = method.removesuffix(TOGETHER).removeprefix(PUBLISHED)
    if base != method:
        return style_of(base)._replace(second=True)
    number = zlib.crc32(method.encode())
    mark = OTHERS[number // len(PALETTE) % len(OTHERS)]
    return METHODS.get(method, MethodStyle(PALETTE[number % len(PALETTE)], mark, True))


def numbered_style(number: int) -> dict[str, Any]:
    """Colour and line style of the setting with this number,
    where settings are drawn and not methods.
    """
    turn, colour = divmod(number, len(PALETTE))
    return {"color": PALETTE[colour], "linestyle": STROKES[turn % len(STROKES)]}


def panels(
    width: float, height: float, rows: int = 1, columns: int = 1, *, grid: bool = True, **how: Any
) -> tuple[Figure, np.ndarray]:
    """Return a figure of `width` x `height` inches in our style and axes (rows, columns)
    with grid lines.

    At most 9 inches of width stay readable at 600 pixels.
    """
    matplotlib.rcParams.update(STYLE)  # text and lines that are added later read it too
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **how)
    for axis in axes.flat if grid else ():
        axis.grid(alpha=0.3)
    return figure, axes


def colour_bar(image: Any, axes: Any, label: str, **how: Any) -> None:
    """Say what the colours of an image mean, beside one axes or several that share them."""
    beside = np.ravel(axes).tolist()
    beside[0].figure.colorbar(image, ax=beside, label=label, **{"shrink": 0.85, "pad": 0.02} | how)


def set_log_axis(axes: Any, decades: float = 3.0) -> None:
    """Set the horizontal axis in decades, with plain numbers also between them
    where it has fewer `decades`.

    Linear where nothing is above zero.
    """
    if not np.isfinite(axes.dataLim.minposx):
        return
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    fine = np.log10(high / low) < decades
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if fine else (1,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def set_latency_axes(
    axes: Any, figure_name: str, values: Sequence[float], others: Iterable[tuple[str, float, float]]
) -> None:
    """Mark others by name, milliseconds and accuracy, and set axes on which better is up.

    Those far below the `values` that the picture is about leave it: they would flatten these.
    """
    for name, ms, value in others:
        look = style_of(name)
        axes.plot([ms], [value], ms=5, **look.marked)
        axes.annotate(
            name,
            (ms, value),
            (5, -3),
            annotation_clip=True,
            textcoords="offset points",
            fontsize=7,
            color=look.colour,
        )
    set_log_axis(axes)
    axes.set(
        xlabel="one query [ms], median; whisker to the 95th percentile", ylabel=axis_of(figure_name)
    )
    if lower_is_better(figure_name):
        if np.isfinite(axes.dataLim.minposy):  # errors span decades
            axes.set_yscale("log")
        axes.invert_yaxis()
    elif len(values) > 1:
        middle, best = float(np.median(values)), max(values)
        axes.set_ylim(bottom=max(axes.get_ylim()[0], middle - max(3 * (best - middle), 5.0)))


LABEL = "label"  # marks annotations that may be moved
# Offsets [points] and alignments that are tried: beside the point first, then farther off
OFFSETS = tuple(
    (far * x, far * y, ("right", "center", "left")[x + 1], ("top", "center", "bottom")[y + 1])
    for far in (6, 14, 26)
    for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
)


def spread_labels(figure: Figure) -> None:
    """Move labels to where they cover neither one another, nor a labelled point, nor leave their
    axes; those that fit nowhere are hidden.
    """
    labels = [
        (axis, text)
        for axis in figure.axes
        for text in axis.texts
        if isinstance(text, Annotation) and text.get_gid() == LABEL
    ]
    if not labels:
        return
    figure.draw_without_rendering()  # places the axes, which offsets count from
    texts = [text for axis in figure.axes for text in axis.texts if text.get_gid() != LABEL]
    taken = [text.get_window_extent() for text in texts]
    points = [axis.transData.transform(label.xy) for axis, label in labels]
    taken += [Bbox([point - 3, point + 3]) for point in points]
    for axis, label in labels:
        for x, y, across, up in OFFSETS:
            label.set(position=(x, y), ha=across, va=up)
            box = label.get_window_extent()
            inside = axis.bbox.padded(1)
            within = inside.contains(box.x0, box.y0) and inside.contains(box.x1, box.y1)
            if within and not box.count_overlaps(taken):
                taken.append(box)
                break
        else:
            label.set_visible(False)


def save(figure: Figure, path: Path, dpi: float = 110, also: Iterable[str] = ()) -> None:
    """Write a figure in the format of its ending, atomically, and beside it in others: `pdf`,
    `svg`.
    """
    spread_labels(figure)
    for file in (path, *(path.with_suffix(f".{form}") for form in also)):
        with whole_file(file) as partial:
            figure.savefig(partial, dpi=dpi, format=file.suffix[1:].lower() or "png")

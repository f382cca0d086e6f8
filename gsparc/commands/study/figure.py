"""A study as a figure: accuracy against an error, against the number of measurements, or against its cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsparc.commands.study.study import Row
from gsparc.evaluation.drawing import logarithmic, panels, save
from gsparc.evaluation.figures import lower_is_better


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        what: condition whose rows are drawn.
        label: of the horizontal axis.
        x: horizontal coordinate of a row.
        y: vertical coordinate; None: the accuracy.
    """

    what: str
    label: str
    x: Callable[[Row], float]
    y: Callable[[Row], float] | None = None


TRAINING = "training of one model [s]"
PANELS = (
    Panel("query", "position error in queries [cm]", lambda row: 100 * row.amount),
    Panel("train", "position error in training [cm]", lambda row: 100 * row.amount),
    Panel("directions", "error of directions of arrival [degrees]", lambda row: row.amount),
    Panel("keep", "measurements learned from", lambda row: row.rows),
    Panel("keep", "measurements learned from", lambda row: row.rows, lambda row: row.train_s),
)
COSTS = (
    Panel("none", TRAINING, lambda row: row.train_s),
    Panel("none", "one query, median [ms]", lambda row: row.query_ms),
)


def draw(rows: Sequence[Row], title: str, path: Path) -> None:
    """Save the figure as PNG; a dotted line is the variant's accuracy on undisturbed data."""
    drawn = {row.what for row in rows}
    wanted = [panel for panel in PANELS if panel.what in drawn] or list(COSTS)
    figure, grid = panels(5 * len(wanted), 4, 1, len(wanted))
    figure.suptitle(title, fontsize=11)
    for axes, panel in zip(grid[0], wanted, strict=True):
        for name in dict.fromkeys(row.variant for row in rows):
            own = [row for row in rows if row.variant == name and row.what == panel.what]
            if not own:
                continue
            x, y = [panel.x(row) for row in own], [panel.y(row) if panel.y else row.value for row in own]
            spread = None if panel.y else [row.spread or 0.0 for row in own]
            (line, *_) = axes.errorbar(x, y, spread, marker="o", capsize=2, label=name)
            clean = [row.value for row in rows if row.variant == name and row.what == "none"]
            if clean and panel.what != "none":
                axes.axhline(clean[0], color=line.get_color(), linestyle=":", linewidth=1)
        logarithmic(axes)
        axes.set_xlabel(panel.label)
        axes.set_ylabel(TRAINING if panel.y else rows[0].figure)
        if panel.y:
            axes.set_yscale("log")
        elif lower_is_better(rows[0].figure):
            axes.invert_yaxis()
    grid[0, 0].legend(fontsize=8)
    save(figure, path)

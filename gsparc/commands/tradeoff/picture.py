"""Accuracy against latency drawn: the front, numbered, and its legend beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from gsparc.evaluation.drawing import logarithmic, look, panels
from gsparc.evaluation.figures import lower_is_better, score_of
from gsparc.models.pareto import Point

NAMES = {
    "psnr_db": "PSNR [dB]", "nmse": "NMSE", "rmse_db": "RMSE [dB]", "ssim_gauss": "SSIM (11 x 11 Gaussian)"
}  # fmt: skip


@dataclass(frozen=True)
class Other:
    """Another method on the same axes: its accuracy and median latency [ms]."""

    value: float
    p50: float
    p95: float


def beaten_by(point: Point, others: Mapping[str, Other], figure_name: str) -> str | None:
    """The most accurate other that is neither slower nor worse than a point; None when there is none."""
    own = score_of(figure_name, point.value(figure_name))
    better = {n: score_of(figure_name, r.value) for n, r in others.items() if r.p50 <= point.p50}
    best = max(better, key=lambda name: better[name], default=None)
    return best if best is not None and better[best] >= own else None


def draw(
    points: Sequence[Point],
    on_front: Sequence[int],
    others: Mapping[str, Other],
    figure_name: str,
    method: str,
    title: str,
) -> Figure:
    """The picture.

    Args:
        points: all of them.
        on_front: indices of the front, fastest first.
        others: baselines and peers by name.
        figure_name: key of the accuracy.
        method: whose points they are.
        title: what was measured.
    """
    lines = 0.16 * (len(on_front) + 1)  # inches of the legend
    figure, ((axes,), (legend,)) = panels(7.5, 4.2 + lines, 2, 1, grid=False, height_ratios=(4.2, lines))
    value = [p.value(figure_name) for p in points]
    inside = [i for i in range(len(points)) if i not in on_front]
    axes.scatter([points[i].p50 for i in inside], [value[i] for i in inside], s=9, c="0.75", label="beaten")

    x, y = [points[i].p50 for i in on_front], [value[i] for i in on_front]
    reach = [[0.0] * len(x), [points[i].p95 - points[i].p50 for i in on_front]]
    own, label = look(method).colour, "not beaten (to 95th percentile)"
    axes.errorbar(x, y, xerr=reach, fmt="o-", color=own, capsize=2, lw=1, ms=4, label=label)
    for number, place in enumerate(zip(x, y, strict=True), 1):
        above = (-9, 5 if number % 2 else -13)  # or below: near points would cover each other's numbers
        axes.annotate(str(number), place, above, textcoords="offset points", color=own, fontsize=9)
    for name, other in others.items():
        axes.plot([other.p50], [other.value], ms=6, **look(name).marked)
        place = other.p50, other.value
        axes.annotate(name, place, (6, -4), textcoords="offset points", color=look(name).colour)
    logarithmic(axes)
    worst, best = min(y), max(y)  # far-off others would flatten the front
    if lower_is_better(figure_name):
        axes.set_yscale("log")
        axes.invert_yaxis()
    else:
        axes.set_ylim(worst - 0.4 * (best - worst) - 0.5, best + 0.15 * (best - worst) + 0.1)
        below = [name for name, other in others.items() if other.value < axes.get_ylim()[0]]
        if below:
            axes.text(0.01, 0.01, f"below: {', '.join(below)}", transform=axes.transAxes, fontsize=8)
    axes.set(xlabel="one query end to end, median [ms]", ylabel=NAMES.get(figure_name, figure_name))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize=8)
    axes.set_title(title, fontsize=10)
    winner = {i: beaten_by(points[i], others, figure_name) for i in on_front}
    told = [
        f"{number:2d}  {points[i].p50:7.3g} ms  {value[i]:7.4g}  {points[i].label}"
        + (f" ({winner[i]} is better)" if winner[i] else "")
        for number, i in enumerate(on_front, 1)
    ]
    legend.axis("off")
    text = "\n".join(["       median  accuracy  settings", *told])
    legend.text(0, 1, text, va="top", family="monospace", fontsize=7.5)
    return figure

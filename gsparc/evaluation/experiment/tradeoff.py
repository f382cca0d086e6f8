"""Combinations of knobs scored on the test rows and timed in turns, and their front drawn."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.baselines import FittedBaseline, fit_baseline
from gsparc.evaluation.drawing import panels, set_log_axis, style_of
from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.metric_formats import DECIDING, axis_of, lower_is_better, score_of
from gsparc.evaluation.open_runs import Opened
from gsparc.evaluation.scores import rows_to_score, score_methods
from gsparc.evaluation.table import Column
from gsparc.models.method import Method, Prediction
from gsparc.models.per_station import PerStation
from gsparc.models.reduced import View
from gsparc.prediction.pareto import Point, Settings, describe_point
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import Call, ClockSettings, time_interleaved

log = logging.getLogger(__name__)

POINT = (  # columns of the table of points
    Column("not beaten", "", of="label"), Column("ms p50", ".3g", of="render_ms_p50"),
    Column("ms p95", ".3g", of="render_ms_p95"),
)  # fmt: skip
CLOSEST_DB = 100.0  # the precision of float32


def measure_candidates(
    candidates: Sequence[tuple[Settings, Method]], threads: Sequence[int], data: Measurements, fold: Fold, *,
    eval_on: str, clock: ClockSettings, others: Mapping[str, Call],
) -> tuple[list[Point], dict[str, np.ndarray]]:  # fmt: skip
    """Measure the candidates; the first is the full model, which the others are compared with.

    Args:
        candidates: to be measured: what a method is reduced by, and the method that answers so.
        threads: CPU threads that each is timed with.
        data, fold: as the model was trained with.
        eval_on: rows whose figures are shown.
        clock: how long to measure.
        others: further contenders for the clock alone (a copy of memory), by name.

    Returns:
        A point per candidate and number of threads, and the times [ms] of `others`.
    """
    split = Split("tradeoff", (fold,), "")
    scored: list[tuple[dict[str, float | None], float]] = []
    whole = None
    places = data.moving[rows_to_score(fold, eval_on)]
    for number, (_, method) in enumerate(candidates):
        recorded = RecordingView(method)
        there = score_methods([recorded], data, split, eval_on)
        answers = torch.cat(recorded.means)
        whole = answers if whole is None else whole
        scored.append((pool_figures(there, data, split), closeness_db(answers, whole)))
        if number % 10 == 9:
            log.info("%d of %d faster variants scored", number + 1, len(candidates))
    calls: dict[tuple[int, int] | str, Call] = {name: call for name, call in others.items()}
    for index, (_, method) in enumerate(candidates):
        ask = Predictor(method, data.site).cycle_places(places)
        calls |= {(index, count): ask for count in threads}
    # A copy of memory, the unit of the others' times, is made by one thread.
    times = time_interleaved(calls, clock, {key: 1 if isinstance(key, str) else key[1] for key in calls})
    points = []
    for key, ms in times.items():
        if isinstance(key, str):
            continue
        index, count = key
        (settings, method), (figures, close) = candidates[index], scored[index]
        label = f"{describe_point(settings)}, {count} thread{'s' if count > 1 else ''}"
        points.append(Point(label, settings, count, figures, close, ms, method.count_components()))
    return points, {name: times[name] for name in others}


class RecordingView(View):
    """A method whose answers are kept while it is scored.

    Attributes:
        means: of every batch that was asked.
    """

    def __init__(self, inner: Method) -> None:
        super().__init__(inner)
        self.means: list[Tensor] = []

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        prediction = self.inner.predict(query)
        self.means.append(prediction.mean)
        return prediction


def closeness_db(answers: Tensor, whole: Tensor) -> float:
    """Return how near answers (n, ...) are to the full model's [dB], which takes no measurement."""
    # 1e-30: two equal answers, or two of nothing, have no ratio.
    apart, power = (x.abs().square().sum().item() for x in (answers - whole, whole))
    return min(10 * math.log10(max(power, 1e-30) / max(apart, 1e-30)), CLOSEST_DB)


def find_better(point: Point, others: Mapping[str, Point], figure_name: str) -> str | None:
    """Return the most accurate other that is neither slower nor worse than a point; None without one."""
    own = score_of(figure_name, point.value(figure_name))
    better = {n: score_of(figure_name, r.value(figure_name)) for n, r in others.items() if r.p50 <= point.p50}
    best = max(better, key=lambda name: better[name], default=None)
    return best if best is not None and better[best] >= own else None


def draw_front(
    points: Sequence[Point], on_front: Sequence[int], others: Mapping[str, Point], figure_name: str,
    method: str, title: str,
) -> Figure:  # fmt: skip
    """Draw the points of a method beside others by name; `on_front` are of the front, fastest first."""
    lines = 0.16 * (len(on_front) + 1)  # inches of the legend
    figure, ((axes,), (legend,)) = panels(7.5, 4.2 + lines, 2, 1, grid=False, height_ratios=(4.2, lines))
    value = [p.value(figure_name) for p in points]
    inside = [i for i in range(len(points)) if i not in on_front]
    axes.scatter([points[i].p50 for i in inside], [value[i] for i in inside], s=9, c="0.75", label="beaten")

    x, y = [points[i].p50 for i in on_front], [value[i] for i in on_front]
    reach = [[0.0] * len(x), [points[i].p95 - points[i].p50 for i in on_front]]
    own, label = style_of(method).colour, "not beaten (to 95th percentile)"
    axes.errorbar(x, y, xerr=reach, fmt="o-", color=own, capsize=2, lw=1, ms=4, label=label)
    for number, place in enumerate(zip(x, y, strict=True), 1):
        above = (-9, 5 if number % 2 else -13)  # or below: near points would cover each other's numbers
        axes.annotate(str(number), place, above, textcoords="offset points", color=own, fontsize=9)
    for name, other in others.items():
        axes.plot([other.p50], [other.value(figure_name)], ms=6, **style_of(name).marked)
        place = other.p50, other.value(figure_name)
        axes.annotate(name, place, (6, -4), textcoords="offset points", color=style_of(name).colour)
    set_log_axis(axes)
    worst, best = min(y), max(y)  # far-off others would flatten the front
    if lower_is_better(figure_name):
        axes.set_yscale("log")
        axes.invert_yaxis()
    else:
        axes.set_ylim(worst - 0.4 * (best - worst) - 0.5, best + 0.15 * (best - worst) + 0.1)
        below = [name for name, other in others.items() if other.value(figure_name) < axes.get_ylim()[0]]
        if below:
            axes.text(0.01, 0.01, f"below: {', '.join(below)}", transform=axes.transAxes, fontsize=8)
    axes.set(xlabel="one query end to end, median [ms]", ylabel=axis_of(figure_name))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize=8)
    axes.set_title(title, fontsize=10)
    winner = {i: find_better(points[i], others, figure_name) for i in on_front}
    rows = [
        f"{number:2d}  {points[i].p50:7.3g} ms  {value[i]:7.4g}  {points[i].label}"
        + (f" ({winner[i]} is better)" if winner[i] else "")
        for number, i in enumerate(on_front, 1)
    ]
    legend.axis("off")
    text = "\n".join(["       median  accuracy  settings", *rows])
    legend.text(0, 1, text, va="top", family="monospace", fontsize=7.5)
    return figure


def fit_others(run: Opened, baselines: Sequence[str], eval_on: str) -> dict[str, FittedBaseline]:
    """Fit baselines whose deciding figure is defined."""
    fitted = {name: fit_baseline(name, run.data, run.split, eval_on) for name in baselines}
    figure = DECIDING[run.data.site.scored]
    return {name: one for name, one in fitted.items() if one.scores.figures()[figure] is not None}


def table_of_points(
    points: list[Point], pareto: list[int], chosen: list[int], copy_ms: float
) -> pd.DataFrame:
    """Return a row a point, those of `tradeoff.csv`: the fastest first."""
    rows = [
        {
            "label": p.label, "render_ms_p50": p.p50, "render_ms_p95": p.p95,
            "ratio_to_copy": p.p50 / copy_ms, **p.figures,
            "closeness_db": p.closeness_db, "front": int(i in pareto), "kept_with_model": int(i in chosen),
            "threads": p.threads, "num_gaussians": p.size,
            **{f"set/{knob}": _cell(value) for knob, value in p.settings.items()},
        }
        for i, p in enumerate(points)
    ]  # fmt: skip
    return pd.DataFrame(rows, dtype=object).sort_values("render_ms_p50", kind="stable")


def _cell(value: Any) -> Any:
    return "+".join(map(str, value)) if isinstance(value, (list, tuple)) else value


def facts_of(
    points: list[Point], best: list[Point], figure: str, others: dict[str, Point], copy_ms: float
) -> dict[str, Any]:
    """Return `tradeoff/*`, `baseline/<name>/*` and the full model's time and accuracy."""
    full = min((p for p in points if not p.settings), key=lambda p: p.p50)
    facts: dict[str, Any] = {
        "tradeoff/points": len(points),
        "tradeoff/front": len(best),
        "tradeoff/figure": figure,
        "tradeoff/front_beaten_by_others": sum(find_better(p, others, figure) is not None for p in best),
        "time/copy_ms": copy_ms,
        "time/render_ms_p50": full.p50,
        "time/render_ms_p95": full.p95,
        f"test/{figure}": full.value(figure),
    }
    for name, other in others.items():
        stem = f"baseline/{name}"
        facts |= {f"{stem}/{figure}": other.value(figure), f"{stem}/render_ms_p50": other.p50}
    return facts


def why_irreducible(method: Method) -> list[str]:
    """Return a sentence where there is nothing to weigh against time."""
    if method.reduction_settings():
        return []
    why = "it has no Gaussians, sources, components or variances to spare"
    if isinstance(method, PerStation):
        why = "one of several stations is asked as it was trained"
    return [f"{method.name}: nothing of it can be reduced, so that there is one point ({why})"]

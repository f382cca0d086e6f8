"""Combinations of knobs scored on the test rows and timed in turns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.metric_formats import deciding_figure, score_of
from gsparc.evaluation.scores import rows_to_score, score_methods
from gsparc.evaluation.table import Column, Row
from gsparc.models.method import Method
from gsparc.models.per_station import PerStation
from gsparc.models.reduced import Settings
from gsparc.prediction.operating_point import defined_figure, describe_point, pareto_front
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import FACTS, ClockSettings, time_beside_copy
from gsparc.runs.baselines import fit_baseline
from gsparc.runs.experiment.runner import run_skipping_failures

POINT = (  # columns of the table of points
    Column("not beaten", "", of="label"),
    Column("ms p50", ".3g", of="render_ms_p50"),
    Column("ms p95", ".3g", of="render_ms_p95"),
)
MADE = ["settings", "figure", "value", "score"]  # columns that are not in `tradeoff.csv`
CLOSEST_DB = 100.0  # the precision of float32


def measure_points(
    candidates: Sequence[tuple[Settings, Method]],
    threads: Sequence[int],
    baselines: Sequence[str],
    data: Measurements,
    split: Split,
    eval_on: str,
    clock: ClockSettings,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Score and time ways of answering; the first is the full model,
    which the others are compared with.

    Args:
        candidates: what a method is reduced by, and the method that answers so.
        threads: CPU threads that each is timed with.
        baselines: names of others beside them; those that do not serve the data, or whose deciding
            figure is not defined, are left out, as are candidates that fail.
        data, split: as the model was trained with, its fold.
        eval_on: rows whose figures are shown.
        clock: how long to measure.

    Returns:
        A row per candidate and number of threads, the fastest first, and one per other. Columns are
        the those of `tradeoff.csv`, `settings`, and of the deciding figure its name `figure`,
        `value` and `score`, larger is better. `front` marks those that no candidate beats,
        `kept_with_model` those by their closeness to the full model, which takes no measurement.

    Raises:
        ValueError: these rows do not define the deciding figure.
    """
    how = data, split, eval_on

    def score(candidate: tuple[Settings, Method]) -> dict[str, Any]:
        figures, answers = _score(candidate[1], *how)
        return figures | {"closeness_db": closeness_db(answers, whole)}

    results, whole = _score(candidates[0][1], *how)
    figure, ways = deciding_figure(results, data.site.scored), list[dict[str, Any]]()
    first = candidates[0], results | {"closeness_db": closeness_db(whole, whole)}
    others = run_skipping_failures(
        score, candidates[1:], "points", name=lambda one: describe_point(one[0])
    )
    for (settings, method), results in chain([first], others):
        knobs = {
            f"set/{knob}": "+".join(map(str, v)) if isinstance(v, (list, tuple)) else v
            for knob, v in settings.items()
        }
        results |= {"front": 0, "kept_with_model": 0}
        for used in threads:
            label = f"{describe_point(settings)}, {used} thread{'s' * (used > 1)}"
            sizes = {
                "threads": used,
                "num_gaussians": method.count_components(),
                "settings": settings,
            }
            row = {"label": label, **dict.fromkeys(FACTS.values()), **results, **sizes, **knobs}
            ways.append(row | {"method": method})
    count = len(ways)
    for name, fitted in run_skipping_failures(
        lambda one: fit_baseline(one, *how), baselines, "baselines"
    ):
        results = pool_figures(fitted.scores, data, split)
        if results[figure] is not None:
            ways.append({**results, "label": name, "threads": 1, "method": fitted.methods[0]})
    rows = pd.DataFrame(ways, dtype=object)
    # Predictors are asked in world coordinates, as a user would.
    places = data.moving[rows_to_score(split.folds[0], eval_on)]
    calls = {
        i: Predictor(method, data.site).cycle_places(places)
        for i, method in rows.pop("method").items()
    }
    times = pd.DataFrame(time_beside_copy(calls, clock, rows.threads.to_dict())).T
    rows = rows.assign(**{fact: times[name] for name, fact in FACTS.items()})
    rows = rows.assign(figure=figure, value=[defined_figure(way, figure) for way in ways])
    rows["score"] = [score_of(figure, value) for value in rows.value]
    points, beside = rows[:count].copy(), rows[count:]
    for column, by in (("front", points.score), ("kept_with_model", points.closeness_db)):
        points.loc[pareto_front(points.render_ms_p50.to_list(), by.to_list()), column] = 1
    return points.sort_values("render_ms_p50", kind="stable"), beside


def _score(
    method: Method, data: Measurements, split: Split, eval_on: str
) -> tuple[dict[str, Any], Tensor]:
    """Figures of a method, and its answers (n, ...) in the order of batches."""
    means: list[Tensor] = []
    scores = score_methods([method], data, split, eval_on, means=means)
    return pool_figures(scores, data, split), torch.cat(means)


def closeness_db(answers: Tensor, whole: Tensor) -> float:
    """Return how near answers (n, ...) are to the full model's [dB], which takes no measurement."""
    # 1e-30: two equal answers, or two of nothing, have no ratio.
    gap, power = (x.abs().square().sum().item() for x in (answers - whole, whole))
    return min(10 * math.log10(max(power, 1e-30) / max(gap, 1e-30)), CLOSEST_DB)


def find_better(point: Row, others: pd.DataFrame) -> str | None:
    """Return the most accurate other that is neither slower nor worse than a point;
    None without one.
    """
    better = others[
        (others.render_ms_p50 <= point["render_ms_p50"]) & (others.score >= point["score"])
    ]
    return None if better.empty else str(better.label[better.score.astype(float).idxmax()])


def facts_of(points: pd.DataFrame, others: pd.DataFrame) -> dict[str, Any]:
    """Return `tradeoff/*`, `baseline/<name>/*` and the full model's time and accuracy."""
    best = points[points.front == 1].to_dict("records")
    # The fastest of its threads
    full = next(row for row in points.to_dict("records") if not row["settings"])
    figure = full["figure"]
    facts: dict[str, Any] = {
        "tradeoff/points": len(points),
        "tradeoff/front": len(best),
        "tradeoff/figure": figure,
        "tradeoff/front_beaten_by_others": sum(
            find_better(row, others) is not None for row in best
        ),
        "time/copy_ms": full["render_ms_p50"] / full["ratio_to_copy"],
        **{f"time/{name}": full[name] for name in ("render_ms_p50", "render_ms_p95")},
        f"test/{figure}": full["value"],
    }
    for other in others.itertuples():
        stem = f"baseline/{other.label}"
        facts |= {f"{stem}/{figure}": other.value, f"{stem}/render_ms_p50": other.render_ms_p50}
    return facts


def why_irreducible(method: Method) -> list[str]:
    """Return a sentence where there is nothing to weigh against time."""
    if method.reduction_settings():
        return []
    why = "it has no Gaussians, sources, components or variances to spare"
    if isinstance(method, PerStation):
        why = "one of several stations is asked as it was trained"
    return [f"{method.name}: nothing of it can be reduced, so that there is one point ({why})"]

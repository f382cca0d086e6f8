"""Every combination of knobs scored on the test rows and timed in turns with all others."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation import paired_differences
from gsparc.method import Method
from gsparc.predictor import Predictor
from gsparc.scoring import Scores, rows_of, score
from gsparc.tradeoff.points import FIGURES, Point, Settings, score_of, worded
from gsparc.tradeoff.timing import Pace, in_turns

log = logging.getLogger(__name__)

PAIRED = {"nmse": "snr_db"}  # an NMSE is of a whole set; its samples are compared by their own ratios


@dataclass(frozen=True)
class Candidate:
    """One way of answering, before it is measured.

    Attributes:
        label: in words.
        settings: what is spared.
        method: answers so.
        threads: CPU threads to be timed with.
    """

    label: str
    settings: Settings
    method: Method
    threads: tuple[int, ...]


def asker(method: Method, data: Measurements, rows: np.ndarray) -> Callable[[int], object]:
    """A query end to end: a world position as a user holds it in, an array in physical units out.

    Args:
        method: fitted.
        data: where the positions come from.
        rows: (n,), asked one after the other.
    """
    ask = getattr(Predictor(method, data.site), data.site.kind)
    moving = data.site.moving_end
    places = data.moving[rows] + data.site.origin
    return lambda number: ask(**{moving: places[number % len(places)]})


def sweep(
    candidates: Sequence[Candidate],
    data: Measurements,
    fold: Fold,
    *,
    eval_on: str,
    choose_on: str,
    pace: Pace,
    others: Mapping[str, Callable[[int], object]],
) -> tuple[list[Point], dict[str, np.ndarray]]:
    """Measure the candidates; the first is the full model, which the others are compared with.

    Args:
        candidates: to be measured.
        data, fold: as the model was trained with.
        eval_on: rows whose figures are shown.
        choose_on: rows that decide which points are worth keeping with the model.
        pace: of the clock.
        others: further contenders for the clock alone (a copy of memory), by name.

    Returns:
        A point per candidate and number of threads, and the times [ms] of `others`.
    """
    figure = FIGURES[data.site.kind]
    split = Split("tradeoff", (fold,), "")
    scored: list[tuple[Scores, float]] = []
    for number, candidate in enumerate(candidates):
        there = score([candidate.method], data, split, eval_on)
        deciding = score([candidate.method], data, split, choose_on).figures()[figure]
        scored.append((there, score_of(figure, float("inf") if deciding is None else deciding)))
        if number % 10 == 9:
            log.info("%d of %d combinations scored", number + 1, len(candidates))
    calls: dict[tuple[int, int] | str, Callable[[int], object]] = {
        name: call for name, call in others.items()
    }
    threads: dict[tuple[int, int] | str, int] = dict.fromkeys(others, 1)
    rows = rows_of(fold, eval_on)
    for index, candidate in enumerate(candidates):
        ask = asker(candidate.method, data, rows)
        for count in candidate.threads:
            calls[index, count], threads[index, count] = ask, count
    times = in_turns(calls, threads, pace)
    points = []
    for key, ms in times.items():
        if isinstance(key, str):
            continue
        index, count = key
        candidate, (scores, deciding) = candidates[index], scored[index]
        said = f"{candidate.label}, {count} thread{'s' if count > 1 else ''}"
        points.append(
            Point(
                said, candidate.settings, count, scores.figures(), deciding, ms,
                candidate.method.size(), _difference(scores, scored[0][0], figure),
            )
        )  # fmt: skip
    return points, {name: times[name] for name in others}


def _difference(scores: Scores, full: Scores, figure: str) -> tuple[float | None, float | None]:
    found = paired_differences(scores, full, "full")
    stem = f"paired/full/{PAIRED.get(figure, figure)}"
    return found.get(stem), found.get(f"{stem}_se")


def candidate(method: Method, settings: Settings, threads: Sequence[int], label: str = "") -> Candidate:
    """A candidate called after its settings."""
    return Candidate(label or worded(settings), settings, method, tuple(threads))

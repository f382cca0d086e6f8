"""Every combination of knobs scored on the test rows and timed in turns with all others."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Batch, Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.evaluate import paired_differences
from gsparc.evaluation.figures import DECIDING
from gsparc.evaluation.scores import Scores, rows_of, score
from gsparc.models.method import Method, Prediction
from gsparc.models.pareto import Point, Settings
from gsparc.models.reduced import View
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import Call, ClockSettings, interleaved

log = logging.getLogger(__name__)

CLOSEST_DB = 100.0  # the precision of float32
PAIRED = {"nmse": "snr_db"}  # an NMSE is of a whole set; its samples are compared by their own ratios


@dataclass(frozen=True)
class Candidate:
    """One way of answering, before it is measured.

    Attributes:
        label: in words.
        settings: what it is reduced by.
        method: answers so.
        threads: CPU threads to be timed with.
    """

    label: str
    settings: Settings
    method: Method
    threads: tuple[int, ...]


def sweep(
    candidates: Sequence[Candidate], data: Measurements, fold: Fold, *, eval_on: str, clock: ClockSettings,
    others: Mapping[str, Call],
) -> tuple[list[Point], dict[str, np.ndarray]]:  # fmt: skip
    """Measure the candidates; the first is the full model, which the others are compared with.

    Args:
        candidates: to be measured.
        data, fold: as the model was trained with.
        eval_on: rows whose figures are shown.
        clock: how long to measure.
        others: further contenders for the clock alone (a copy of memory), by name.

    Returns:
        A point per candidate and number of threads, and the times [ms] of `others`.
    """
    figure, split = DECIDING[data.site.kind], Split("tradeoff", (fold,), "")
    scored: list[tuple[Scores, float]] = []
    whole = None
    places = data.moving[rows_of(fold, eval_on)] + data.site.origin
    for number, candidate in enumerate(candidates):
        recorded = Recorded(candidate.method)
        there = score([recorded], data, split, eval_on)
        answers = torch.cat(recorded.means)
        whole = answers if whole is None else whole
        scored.append((there, closeness(answers, whole)))
        if number % 10 == 9:
            log.info("%d of %d combinations scored", number + 1, len(candidates))
    calls: dict[tuple[int, int] | str, Call] = {name: call for name, call in others.items()}
    threads: dict[tuple[int, int] | str, int] = dict.fromkeys(others, 1)
    for index, candidate in enumerate(candidates):
        ask = Predictor(candidate.method, data.site).cycling(places)
        for count in candidate.threads:
            calls[index, count], threads[index, count] = ask, count
    times = interleaved(calls, clock, threads)
    points = []
    for key, ms in times.items():
        if isinstance(key, str):
            continue
        index, count = key
        candidate, (scores, close) = candidates[index], scored[index]
        label = f"{candidate.label}, {count} thread{'s' if count > 1 else ''}"
        points.append(
            Point(
                label, candidate.settings, count, scores.figures(), close, ms,
                candidate.method.size(), _difference(scores, scored[0][0], figure),
            )
        )  # fmt: skip
    return points, {name: times[name] for name in others}


class Recorded(View):
    """A method whose answers are kept while it is scored.

    Attributes:
        means: of every batch that was asked.
    """

    def __init__(self, inner: Method) -> None:
        super().__init__(inner)
        self.means: list[Tensor] = []

    def answer(self, batch: Batch) -> Prediction:
        """See `Method.answer`."""
        found = self.inner.answer(batch)
        self.means.append(found.mean)
        return found


def closeness(answers: Tensor, whole: Tensor) -> float:
    """How near answers (n, ...) are to those of the full model [dB]: decides without a single measurement."""
    apart, power = (x.abs().square().sum().item() for x in (answers - whole, whole))
    return min(10 * math.log10(max(power, 1e-30) / max(apart, 1e-30)), CLOSEST_DB)


def _difference(scores: Scores, full: Scores, figure: str) -> tuple[float | None, float | None]:
    found = paired_differences(scores, full, "full")
    stem = f"paired/full/{PAIRED.get(figure, figure)}"
    return found.get(stem), found.get(f"{stem}_se")

"""Uncertainty of figures: bootstrap over test samples, spread over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsparc.evaluation.report.runs import Run

DRAWS = 1000
LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A value and its interval.

    Attributes:
        value: the figure.
        low, high: ends of the interval; None when unknown.
    """

    value: float
    low: float | None = None
    high: float | None = None

    def shown(self, form: str = ".2f") -> str:
        """`29.08 [27.4, 30.6]`."""
        ends = "" if self.low is None or self.high is None else f" [{self.low:{form}}, {self.high:{form}}]"
        return f"{self.value:{form}}{ends}"


def bootstrap(values: np.ndarray, weights: np.ndarray | None = None, seed: int = 0) -> tuple[float, float]:
    """Ends of the 95 % interval of a mean (n,), or of sum(values) / sum(weights), resampling samples.

    Samples are taken as independent; neighbours under `split=grouped` are not, so it is a lower bound.
    """
    draw = np.random.default_rng(seed).integers(0, len(values), (DRAWS, len(values)))
    below = np.ones_like(values) if weights is None else weights
    means = values[draw].sum(1) / np.maximum(below[draw].sum(1), 1e-300)
    tail = (1 - LEVEL) / 2
    return float(np.quantile(means, tail)), float(np.quantile(means, 1 - tail))


def interval(run: Run, figure: str) -> Interval | None:
    """A test figure of a run with its bootstrap interval over test samples; None without the figure."""
    value, parts = run.figure_of(figure), _parts(run, figure)
    if value is None:
        return None
    return Interval(value) if parts is None else Interval(value, *bootstrap(*parts))


def _parts(run: Run, figure: str) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Per-sample numbers whose (weighted) mean is the figure."""
    own = run.samples
    if figure == "nmse" and "error_power" in own and "target_power" in own:
        known = np.isfinite(own["error_power"])
        return own["error_power"][known], own["target_power"][known]
    found = own.get(figure)
    if found is None or found.dtype.kind != "f":
        return None
    found = found[np.isfinite(found)]
    return (found, None) if len(found) > 1 else None


def over_seeds(values: Sequence[float]) -> Interval:
    """Mean, least and largest over seeds."""
    if len(values) == 1:
        return Interval(values[0])
    return Interval(float(np.mean(values)), min(values), max(values))

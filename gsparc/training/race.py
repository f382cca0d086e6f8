"""Candidates race on rows that all left out:
one ends where its mean with the best could gain too little.

Of errors x of the best and y of a candidate their mean of weight w has x + w (y - x). As a
candidate learns, its own part of y falls, and what both miss stays. So does x y, and |x|^2 - x y is
the most that a mean may gain, however far behind the candidate is now: errors say little about that
(J. M. Bates and C. W. J. Granger, "The combination of forecasts", 1969, weigh by both).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from gsparc.processes.uncertainty import standard_error

LEAST_GAIN = 0.03  # of the squared error of the best, by a mean with a candidate
SURE = 1.0  # standard errors of paired rows
FAR = 5.0  # times the error of the best: what stalls there has a part of its own that will not fall
# Of a candidate's error a look ago: what falls more may yet learn what the best misses, too
STALLED = 0.8


class FellBehind(ValueError):
    """A candidate ends: no mean of it and another is surely better than that."""


@dataclass(frozen=True)
class Race:
    """The best candidate so far, for those that follow.

    Attributes:
        rows: (n,) that it left out.
        missed: (n, ...) its errors there, real or complex.
        error: a share of the targets' energy there.
        note: is told of each look at a candidate: what, and its mean squared error per entry.
    """

    rows: np.ndarray
    missed: Tensor
    error: float
    note: Callable[[str, float], None]

    @staticmethod
    def from_mean(
        rows: np.ndarray, mean: Tensor, target: Tensor, note: Callable[[str, float], None]
    ) -> Race:
        """Return a candidate that predicts `mean` (n, ...) at rows (n,),
        where `target` was measured.
        """
        missed = (mean - target).detach()
        return Race(rows, missed, mean_square(missed) / max(mean_square(target), 1e-30), note)

    def check_candidate(
        self,
        name: str,
        rows: np.ndarray,
        missed: Tensor,
        before: Sequence[float] = (0.0,),
        finished: bool = False,
    ) -> float:
        """Return the mean squared error of another candidate, where both left rows out.

        Args:
            name: of it, for the learning curve.
            rows: (m,) rows, which it missed by `missed` (m, ...).
            before: what was returned at earlier looks; empty at the first.
            finished: whether it learns no more: then it need not have stalled.

        Raises:
            FellBehind: it is `STALLED` while `FAR` behind, or weighing it gains less than
                `LEAST_GAIN`, even `SURE` errors above.
        """
        now = mean_square(missed)
        self.note(name, now)
        _, own, theirs = np.intersect1d(self.rows, rows, return_indices=True)
        best, candidate = (each.detach().flatten(1) for each in (self.missed[own], missed[theirs]))
        if not finished and now <= STALLED * (before[-1] if before else math.inf):
            return now
        difference, whole = best - candidate, max(float(best.abs().square().sum()), 1e-30)
        gains = (best * difference.conj()).real.double().sum(1) / whole
        gain, error = float(gains.sum()), standard_error(gains.numpy()) * len(gains)
        reference = f"the best so far (error {self.error:.3f} of the energy of rows held out)"
        if now > FAR * mean_square(best):
            raise FellBehind(
                f"{name}: {now / mean_square(best):.0f} times the error of {reference}"
            )
        if gain + SURE * error < LEAST_GAIN:
            raise FellBehind(
                f"{name}: averaging it with {reference} gains {gain:.0%} ± {error:.0%}"
            )
        return now


def mean_square(values: Tensor) -> float:
    """Return the mean squared size of entries, real or complex."""
    return float(values.detach().abs().double().square().mean())

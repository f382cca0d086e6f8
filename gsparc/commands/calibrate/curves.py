"""Risk against coverage: how wrong the accepted predictions are when the surest are accepted first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import spearmanr


@dataclass(frozen=True)
class RiskCoverage:
    """Mean loss of the surest share of predictions.

    Attributes:
        coverage: (n,) shares accepted, 1 / n to 1.
        risk: (n,) mean loss among them.
    """

    coverage: np.ndarray
    risk: np.ndarray

    @property
    def area(self) -> float:
        """Mean risk over all coverages (Geifman, Uziel and El-Yaniv 2019)."""
        return float(self.risk.mean())

    def at(self, coverage: float) -> float:
        """Risk of the surest `coverage` of all."""
        return float(self.risk[max(round(coverage * len(self.risk)), 1) - 1])


def bounded(relative_error: np.ndarray) -> np.ndarray:
    """Losses (n,) in [0, 1]: |e|^2 / |h|^2, where 1 (no better than silence) is as bad as it gets."""
    return np.minimum(relative_error, 1.0)


def risk_coverage(score: np.ndarray, loss: np.ndarray) -> RiskCoverage:
    """Accept by falling score (n,); equal scores share their mean loss (n,): their order cannot matter.

    Raises:
        ValueError: not as many scores as losses, or none.
    """
    if len(score) != len(loss) or not len(score):
        raise ValueError(f"expected as many scores as losses, and some: got {len(score)} and {len(loss)}")
    order = np.argsort(-score, kind="stable")
    sorted_score, sorted_loss = score[order], loss[order].astype(np.float64)
    _, group = np.unique(-sorted_score, return_inverse=True)
    shared = (np.bincount(group, sorted_loss) / np.bincount(group))[group]
    count = np.arange(1, len(score) + 1)
    return RiskCoverage(count / len(score), np.cumsum(shared) / count)


def perfect_area(loss: np.ndarray) -> float:
    """Area of a confidence that knows the losses (n,)."""
    return risk_coverage(-loss, loss).area


def rank_correlation(score: np.ndarray, loss: np.ndarray) -> float | None:
    """Spearman's correlation of being sure (n,) and being right, minus the loss (n,); None of a constant."""
    if np.ptp(score) == 0 or np.ptp(loss) == 0:
        return None
    return float(spearmanr(score, -loss).statistic)

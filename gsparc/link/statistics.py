"""Block error rates with their intervals, and the Eb/N0 at which a curve crosses its target."""

from __future__ import annotations

import numpy as np
from scipy.stats import beta


def interval(errors: int, blocks: int, level: float = 0.95) -> tuple[float, float]:
    """Clopper and Pearson's interval (1934) of a rate."""
    if blocks == 0:
        return 0.0, 1.0
    tail = (1 - level) / 2
    low = 0.0 if errors == 0 else float(beta.ppf(tail, errors, blocks - errors + 1))
    high = 1.0 if errors == blocks else float(beta.ppf(1 - tail, errors + 1, blocks - errors))
    return low, high


def crossing(x: np.ndarray, rate: np.ndarray, target: float = 0.1) -> float | None:
    """Where a falling curve (n,) first crosses `target`, linear in its logarithm; None if it never does."""
    floor = np.maximum(rate, 1e-6)
    for i in range(len(x) - 1):
        if floor[i] > target >= floor[i + 1]:
            share = np.log(floor[i] / target) / np.log(floor[i] / floor[i + 1])
            return float(x[i] + share * (x[i + 1] - x[i]))
    return None

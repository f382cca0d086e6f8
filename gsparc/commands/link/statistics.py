"""The Eb/N0 at which a curve crosses its target."""

from __future__ import annotations

import numpy as np


def crossing(x: np.ndarray, rate: np.ndarray, target: float = 0.1) -> float | None:
    """Where a falling curve (n,) first crosses `target`, linear in its logarithm; None if it never does."""
    floor = np.maximum(rate, 1e-6)
    for i in range(len(x) - 1):
        if floor[i] > target >= floor[i + 1]:
            share = np.log(floor[i] / target) / np.log(floor[i] / floor[i + 1])
            return float(x[i] + share * (x[i + 1] - x[i]))
    return None

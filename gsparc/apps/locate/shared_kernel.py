"""One kernel for many outputs over places of one or more floors, by densities at places left out."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import Nearest, Values, given, settings_of
from gsparc.processes.prior import Prior

STRONGEST = 24  # outputs that choose the kernel, those of largest variance
VERTICAL = (1.0, 2.0, 4.0, 8.0)  # metres along the floor that a metre of height counts as
STOREY_M = 2.0  # heights that differ by less are of one floor
FEWEST = 3  # places that settings can be chosen on


def stretched(places: np.ndarray, vertical: float) -> np.ndarray:
    """Places (n, D) [m] whose heights, the third coordinate, count `vertical` times."""
    return places * np.array([1.0, 1.0, vertical])[: places.shape[1]]


def settings(outputs: Tensor, places: np.ndarray, seed: int) -> tuple[Prior, float]:
    """Return the kernel of largest density of values left out, and what a metre of height counts as.

    Args:
        outputs: (n, P) less their means.
        places: (n, D) float64 [m], D of 2 or 3.
        seed: of rows that are drawn.
    """
    strong = outputs.square().sum(0).topk(min(STRONGEST, outputs.shape[1])).indices
    few = outputs[:, strong].double()
    size = float(np.linalg.norm(np.ptp(places, axis=0))) or 1.0
    prior, best = Prior(Kernel.of_one(size / 10, 0.1)), VERTICAL[0]
    values = Values.of(places, few)
    if len(values.places) < FEWEST:
        return prior, best
    prior = Prior(settings_of(prior, values, seed)[0])
    if places.shape[1] < 3 or np.ptp(places[:, 2]) < STOREY_M:
        return prior, best
    every = {factor: Values.of(stretched(places, factor), few) for factor in VERTICAL}
    best = min(VERTICAL, key=lambda factor: surprise(given(prior, every[factor], seed)))
    return (prior if best == VERTICAL[0] else Prior(settings_of(prior, every[best], seed)[0])), best


def surprise(process: Nearest) -> float:
    """Negative log density of values at places left out, per value and up to a constant [nats]."""
    mean, left = process.left_out()
    squared = (process.rest - mean).square().mean(1) / left
    return 0.5 * float(squared.mean().log() + left.log().mean())

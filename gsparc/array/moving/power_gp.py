"""Powers of sources over the receiver's position: one Gaussian process per source, one kernel for all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dtrtri
from torch import Tensor

from gsparc.methods.gp import Kernel


@dataclass(frozen=True)
class TrendSettings:
    """Smoothness of the sources' powers.

    Attributes:
        lengths: of the Matern kernels tried, in diagonals of the receivers' box.
        noise: variance relative to the kernel's.
        rows: training rows that the length is chosen on, by leave-one-out error.
    """

    lengths: tuple[float, ...] = (0.06, 0.12, 0.25)
    noise: float = 1.0
    rows: int = 600


@dataclass(frozen=True)
class Trend:
    """The sources of one search and how their powers vary.

    Attributes:
        sources: (K, 3) float32 [m].
        kernel: of the powers over the receivers' places.
        level: (K,) float32 mean powers.
        weights: (n, K) float32, one row per training receiver.
    """

    sources: Tensor
    kernel: Kernel
    level: Tensor
    weights: Tensor

    def powers(self, far: Tensor) -> Tensor:
        """Power (m, K) of every source at places that are `far` (m, n) [m] from the training receivers."""
        return torch.addmm(self.level, matern(far, self.kernel.length), self.weights)

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        return {**vars(self), "kernel": [*vars(self.kernel).values()]}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> Trend:
        """Inverse of `state`."""
        kernel = Kernel(*map(float, state["kernel"]))
        return Trend(state["sources"], kernel, state["level"].float(), state["weights"].float())


def matern(far: Tensor, length: float) -> Tensor:
    """Matern-3/2 correlations of distances [m], as `gsparc.methods.gp.Kernel`."""
    scaled = far * (math.sqrt(3) / length)
    return (1 + scaled) * torch.exp(-scaled)


def solved(kernel: Kernel, places: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (n, K) of centred values (n, K) at places (n, 3) [m], and left-out variances (n,).

    Variances are over the kernel's amplitude; a left-out prediction is `values - weights * variance`
    (Rasmussen and Williams 2006, eq. 5.12).
    """
    factor = cholesky(kernel.gram(places), lower=True)
    spread = 1 / (dtrtri(factor, lower=1)[0] ** 2).sum(0)  # of the inverse's diagonal, without forming it
    return cho_solve((factor, True), values), spread


def fit_trend(
    sources: Tensor, kernel: Kernel, places: np.ndarray, power: np.ndarray
) -> tuple[Trend, np.ndarray]:
    """The trend of powers (n, K) at places (n, 3), and its leave-one-out predictions (n, K)."""
    level = power.mean(0)
    weights, spread = solved(kernel, places, power - level)
    # in the order that a checkpoint keeps: in another one sums differ, and roots of small pixels by more
    stored = torch.from_numpy(np.ascontiguousarray(weights)).float()
    trend = Trend(sources, kernel, torch.from_numpy(level).float(), stored)
    return trend, power - weights * spread[:, None]

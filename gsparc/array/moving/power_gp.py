"""Powers of sources over the receiver's position: one Gaussian process per source, one kernel for all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
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
        level: (K,) mean powers.
        weights: (n, K), one row per training receiver.
    """

    sources: Tensor
    kernel: Kernel
    level: np.ndarray
    weights: np.ndarray

    def powers_at(self, places: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Power (m, K) of every source at places (m, 3) [m]; `known` (n, 3) are the training places."""
        return self.level + self.kernel.cross(places, known) @ self.weights

    def state(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        return {
            "sources": self.sources,
            "kernel": [*vars(self.kernel).values()],
            "level": torch.from_numpy(self.level),
            "weights": torch.from_numpy(self.weights),
        }

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> Trend:
        """Inverse of `state`."""
        kernel = Kernel(*map(float, state["kernel"]))
        return Trend(state["sources"], kernel, state["level"].numpy(), state["weights"].numpy())


def fit_trend(
    sources: Tensor, kernel: Kernel, places: np.ndarray, power: np.ndarray
) -> tuple[Trend, np.ndarray]:
    """The trend of powers (n, K) at places (n, 3), and its leave-one-out predictions (n, K).

    Rasmussen and Williams (2006), eq. 5.12.
    """
    factor = cho_factor(kernel.gram(places), lower=True)
    level = power.mean(0)
    weights = cho_solve(factor, power - level)
    inverse = cho_solve(factor, np.eye(len(places)))
    return Trend(sources, kernel, level, weights), power - weights / np.diag(inverse)[:, None]

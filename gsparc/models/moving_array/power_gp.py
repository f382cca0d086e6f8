"""Powers of sources over the receiver's position: one Gaussian process per source,
one kernel for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.base.limits import internal
from gsparc.processes.kernel import Kernel
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior
from gsparc.processes.stored import Stored


@dataclass(frozen=True)
class TrendSettings:
    """Smoothness of the sources' powers.

    Attributes:
        lengths: of the Matern kernels tried, in diagonals of the receivers' box.
        noise: variance relative to the kernel's.
        rows: training rows that the length is chosen on, by leave-one-out error.
    """

    lengths: tuple[float, ...] = internal((0.06, 0.12, 0.25))
    noise: float = 1.0
    rows: int = 600


@dataclass(frozen=True)
class PowerTrend(Stored):
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

    def powers(self, distance: Tensor) -> Tensor:
        """Return powers (m, K) of sources at places `distance` (m, n)
        [m] from training receivers.
        """
        return torch.addmm(self.level, self.kernel.correlation(distance), self.weights)


def solve_and_leave_out(
    kernel: Kernel, places: np.ndarray, values: Tensor
) -> tuple[Tensor, Tensor]:
    """Return weights (n, K) of centred values (n, K) at places (n, 3) [m],
    and left-out residuals (n, K).
    """
    posterior = Exact.from_values(Prior(kernel), torch.from_numpy(places), values)
    return posterior.weights, posterior.left_out_residuals().residual


def fit_trend(
    sources: Tensor, kernel: Kernel, places: np.ndarray, power: np.ndarray
) -> tuple[PowerTrend, np.ndarray]:
    """Return the trend of powers (n, K) at places (n, 3),
    and its leave-one-out predictions (n, K).
    """
    level = power.mean(0)
    weights, residual = solve_and_leave_out(kernel, places, torch.from_numpy(power - level))
    # in the order that a checkpoint keeps: in another one sums differ,
    # and roots of small pixels by more
    trend = PowerTrend(
        sources, kernel, torch.from_numpy(level).float(), weights.float().contiguous()
    )
    return trend, power - residual.numpy()

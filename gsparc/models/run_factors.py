"""Complex factors of runs: each run of measurements is the channel times one unknown complex
number.

With aligned rows `u_i y_i` a circular Gaussian process of covariance `P C`, the likelihood of the
factors needs the data only as `M_rs = sum over i in r, j in s of conj(y_i) C^-1_ij y_j`: quadratic
in u but for the logarithm of its size, so that each factor has a closed form given the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.models.method import Prediction
from gsparc.processes.stored import Stored

SWEEPS = 200  # of all factors in turn, at most
SETTLED = 1e-9  # largest change of a factor, of the largest factor, at which they end


@dataclass(frozen=True)
class RunFactors(Stored):
    """What the channels of each run were multiplied by, relative to the largest run's.

    Attributes:
        runs: (R,) int64 numbers, as in `Measurements.run`.
        factors: (R,) complex128.
    """

    runs: np.ndarray
    factors: Tensor

    @staticmethod
    def identity() -> RunFactors:
        """Return the factors of channels that are all in phase."""
        return RunFactors(np.zeros(1, np.int64), torch.ones(1, dtype=torch.complex128))

    @staticmethod
    def has_several_runs(data: Measurements, rows: np.ndarray) -> bool:
        """Tell whether rows (n,) are channels of more than one run."""
        return data.site.target.is_complex and len(np.unique(data.runs_of(rows))) > 1

    def __len__(self) -> int:
        return len(self.runs)

    def look_up(self, run: Tensor | None) -> Tensor:
        """Return factors (B,) complex128 of rows of runs (B,);
        1 of runs that were not learned from.
        """
        if run is None or len(self) == 1:
            return torch.ones(1, dtype=torch.complex128)
        same = run.cpu()[:, None] == torch.from_numpy(self.runs)
        return torch.where(same.any(1), (same * self.factors).sum(1), 1.0)

    def apply_factors(self, answer: Prediction, run: Tensor | None) -> Prediction:
        """Return a prediction for the largest run in the phase and level of rows of runs (B,)."""
        if run is None or len(self) == 1:
            return answer
        of = self.look_up(run).to(answer.mean.device)
        factor, level = of[:, None, None].to(answer.mean.dtype), of.abs().square().float()
        variance = None if answer.variance is None else answer.variance * level
        explained = None if answer.explained is None else answer.explained * factor
        return replace(answer, mean=answer.mean * factor, variance=variance, explained=explained)

    def remove_factors(self, data: Measurements) -> Measurements:
        """Return the channels in the phase and level of the largest run, as of one run."""
        if data.run is None or len(self) == 1:
            return data
        factor = self.look_up(torch.from_numpy(data.run)).numpy()
        target = (data.target / factor[:, None, None]).astype(data.target.dtype)
        noise = None if data.noise_variance is None else data.noise_variance / np.abs(factor) ** 2
        return replace(data, target=target, noise_variance=noise, run=None)


def factor_matrix(inverse: np.ndarray, target: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Return M (runs, runs) complex128 of the module's text.

    Args:
        inverse: (n, n) inverse of the rows' covariance.
        target: (n, D) complex.
        run: (n,) int, numbers 0 to runs - 1, each of which occurs.
    """
    member = np.eye(int(run.max()) + 1)[run]
    return member.T @ (inverse * (target.conj() @ target.T)) @ member


def best_run_factors(quadratic: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return what runs are to be multiplied by (runs,), from M (runs, runs)
    of one process or of many summed.

    Args:
        size: (runs,) complex numbers measured in each, above 0; the largest has factor 1.
    """
    scale = np.sqrt(size)
    # The eigenvector of least residual power is right but for the logarithm,
    # and near enough to start from.
    factors = np.linalg.eigh(quadratic / np.outer(scale, scale))[1][:, 0] / scale
    factors = np.where(
        np.abs(factors) > 1e-6 * np.abs(factors).max(), factors, np.abs(factors).max()
    )
    diagonal = quadratic.diagonal().real
    for _ in range(SWEEPS):
        before = factors.copy()
        power = float((factors.conj() @ quadratic @ factors).real) / size.sum()
        for r in range(len(size)):
            others = diagonal[r] * factors[r] - quadratic[r] @ factors
            pull = abs(others)
            # Positive root of diagonal x^2 - pull x - power size = 0,
            # the likelihood's slope by its size.
            twice = max(2 * diagonal[r], np.finfo(float).tiny)
            length = (pull + np.sqrt(pull**2 + 2 * twice * power * size[r])) / twice
            factors[r] = length * (others / pull if pull > 0 else 1.0)
        if np.abs(factors - before).max() <= SETTLED * np.abs(factors).max():
            break
    return factors / factors[size.argmax()]

"""Values of rows given their covariance: density and its slope, means, variances, rows left out.

Real values are Gaussian, complex ones circular (Rasmussen and Williams 2006, chapters 2 and 5).
What a covariance is made of is the caller's: this is all that is done with one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from gsparc.processes.factor import Factor, solve_as_pairs
from gsparc.processes.left_out import LeftOutErrors, left_out_residuals, left_out_signal


@dataclass(frozen=True)
class Conditioned:
    """n rows of R outputs that share their covariance.

    >>> gram = torch.tensor([[2.0, 1.0], [1.0, 2.0]])
    >>> rows = Conditioned.from_gram(gram, torch.tensor([[3.0], [3.0]]))
    >>> rows.mean(torch.tensor([[1.0, 1.0]])), rows.explained_variance(torch.tensor([[1.0, 1.0]]))
    (tensor([[2.]]), tensor([0.6667]))
    >>> rows.left_out()[0].T  # 3 less the 1.5 that the other row says
    tensor([[1.5000, 1.5000]])

    Attributes:
        factor: of the covariance (n, n), noise included.
        values: (n, R) less their mean.
        weights: (n, R), `K^-1 Y`.
    """

    factor: Factor
    values: Tensor
    weights: Tensor

    @classmethod
    def from_gram(
        cls,
        covariance: Tensor,
        values: Tensor,
        failing: Literal["mend", "raise", "ignore"] = "mend",
    ) -> Conditioned:
        """Condition values (n, R) with a covariance (n, n), noise included;
        see `Factor.from_gram`.
        """
        factor = Factor.from_gram(covariance, failing)
        return cls(factor, values, factor.solve(values))

    @property
    def in_float32(self) -> Conditioned:
        """The same in float32."""
        kind = torch.complex64 if self.values.is_complex() else torch.float32
        return Conditioned(
            Factor(self.factor.lower.to(kind)), self.values.to(kind), self.weights.to(kind)
        )

    @cached_property
    def nll(self) -> float:
        """Negative log density up to a constant [nats]."""
        fit = (self.values.conj() * self.weights).real.double().sum()
        both = float(fit + self.values.shape[1] * self.factor.log_determinant)
        # The log density of a circular complex Gaussian has no factor 1/2.
        return both if self.values.is_complex() else 0.5 * both

    @cached_property
    def power(self) -> float:
        """Mean square of the whitened values: the power
        that fits a covariance known up to a factor.
        """
        return float((self.values.conj() * self.weights).real.mean())

    @cached_property
    def nll_gradient(self) -> Tensor:
        """`G = R K^-1 - K^-1 Y Y^H K^-1` (n, n): d nll = trace(G dK),
        half of it where values are real.
        """
        inverse, weights = self.factor.inverse, self.weights
        return inverse.addmm(weights, weights.mH, beta=weights.shape[1], alpha=-1)

    def mean(self, cross: Tensor) -> Tensor:
        """Return the mean (m, R) at places whose covariances with the rows are (m, n)."""
        return weighted_sum(cross, self.weights)

    def explained_variance(self, cross: Tensor) -> Tensor:
        """Return what the rows take from the variance (m,) of places of covariances (m, n)
        with them.
        """
        return self.factor.whiten(cross.mH).abs().square().sum(0)

    def left_out(self, groups: Iterable[Tensor] | None = None) -> LeftOutErrors:
        """Return residuals (n, R) of rows left out, alone or in groups,
        and their variances (n,).
        """
        inverse = self.factor.precision if groups is None else self.factor.inverse
        return left_out_residuals(inverse, self.weights, groups)

    def left_out_signal(
        self, disturbance: Tensor, groups: Iterable[Tensor] | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """Return the same of the signal alone; see `gsparc.processes.left_out.left_out_signal`."""
        return left_out_signal(self.factor.inverse, self.weights, disturbance, groups)


def weighted_sum(cross: Tensor, weights: Tensor) -> Tensor:
    """Return `cross @ weights` (..., m, R); covariances (..., m, n)
    may be real and weights complex.
    """
    if weights.is_complex() and not cross.is_complex():
        return solve_as_pairs(lambda pairs: cross @ pairs, weights)
    return cross @ weights

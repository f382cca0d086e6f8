"""A process conditioned on rows: exactly, or each query on the rows nearest to it.

Many outputs share one covariance. Variances are of a measurement, its noise included, in units of the
kernel's amplitude.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gsparc.processes.averages import MeanVariance
from gsparc.processes.conditioned import weighted_sum
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import distances
from gsparc.processes.left_out import LeftOutErrors, left_out_residuals
from gsparc.processes.nearest import Nearest
from gsparc.processes.neighbourhood import Neighbourhood
from gsparc.processes.prior import Posterior, Prior

BLOCK = 64  # rows of a covariance at a time
MANY, NEAR = 1_000, 64  # rows beyond which the variance is that given so many of the nearest


@dataclass(frozen=True)
class Exact(Posterior):
    """Given n rows with one factor.

    >>> from gsparc.processes.kernel import Kernel
    >>> prior = Prior(Kernel.from_length(length=2.0, noise=0.01))
    >>> places = torch.tensor([[0.0], [1.0], [2.0]], dtype=torch.float64)  # on a line [m]
    >>> posterior = Exact.from_values(prior, places, places.sin())
    >>> answer = posterior.answer(torch.tensor([[1.0], [90.0]], dtype=torch.float64))
    >>> answer.mean[:, 0].round(decimals=1), answer.variance.round(decimals=1)  # at a row, far away
    (tensor([0.8000, 0.0000], dtype=torch.float64), tensor([0., 1.], dtype=torch.float64))

    Attributes:
        prior: see there.
        rows: (n, D) float64 [m].
        weights: (n, P) float64 or complex128, of the covariances with the rows.
        extra: (n,) variance beyond the noise, as pseudo-values have it, of the amplitude.
    """

    prior: Prior
    rows: Tensor
    weights: Tensor
    extra: Tensor

    @classmethod
    def from_values(
        cls, prior: Prior, places: Tensor, values: Tensor, extra: Tensor | None = None,
        factor: Factor | None = None,
    ) -> Exact:  # fmt: skip
        """Condition on values (n, P) at places (n, D) float64 [m]; with their factor where it is known."""
        extra = torch.zeros(len(places), dtype=torch.float64) if extra is None else extra
        factor = _factor(prior, places, extra) if factor is None else factor
        result = cls(prior, places, factor.solve(values - prior.mean(places)), extra)
        result.__dict__["factor"] = factor  # as `cached_property` would keep it
        return result

    @property
    def places(self) -> Tensor:
        """See `Posterior`."""
        return self.rows

    @cached_property
    def factor(self) -> Factor:
        """Factor of the rows' covariance."""
        return _factor(self.prior, self.rows, self.extra)

    def answer(self, queries: Tensor, float64: bool = False) -> MeanVariance:
        """See `Posterior`."""
        columns = self.prior.columns(queries)
        cross, prior = self.cross_covariance(queries, columns), self.prior.variance(columns)
        if self._vecchia is not None:
            variance = self._vecchia.answer(queries).variance
        else:  # rounding may leave a variance below 0 at a row's place
            variance = (prior - self.factor.whiten(cross.T).square().sum(0)).clamp_min(0.0)
        return MeanVariance(self._mean(queries, cross), variance.minimum(prior))

    @cached_property
    def _vecchia(self) -> Nearest | None:
        """What states the variance of many rows: exactly it costs their number squared for each place."""
        if len(self.rows) <= MANY or not self.prior.kernel.is_isotropic:
            return None
        terms = self.factor.whiten(self._trend_columns)
        # Covariance of the terms' weights given the rows: I - H^T K^-1 H, as K holds H H^T.
        spread = torch.eye(terms.shape[1], dtype=terms.dtype) - terms.T @ terms
        none, noise = self.rows.new_zeros(len(self.rows), 1), self.prior.kernel.noise + self.extra
        near = Neighbourhood.from_places(self.rows.numpy(), 0)
        return Nearest(self.prior, near, none, noise, none[: len(spread)], spread, NEAR)

    def mean_at(self, queries: Tensor, float64: bool = False) -> Tensor:
        """See `Posterior`."""
        return self._mean(queries, self.cross_covariance(queries, self.prior.columns(queries)))

    def nearest_distance(self, queries: Tensor) -> Tensor:
        """See `Posterior`."""
        return distances(queries, self.rows).amin(1)

    def _mean(self, queries: Tensor, cross: Tensor) -> Tensor:
        result = weighted_sum(cross, self.weights)
        return result if self.prior.trend is None else self.prior.mean(queries) + result

    def cross_covariance(self, queries: Tensor, columns: Tensor) -> Tensor:
        """Return covariances (B, n) of places (B, D), whose terms are `columns` (B, Q), with the rows."""
        result = self.prior.kernel.correlations(queries, self.rows)
        return result if self.prior.trend is None else result.addmm(columns, self._trend_columns.T)

    @cached_property
    def _trend_columns(self) -> Tensor:
        return self.prior.columns(self.rows)

    def given_values(self) -> Tensor:
        """Return the values that it was given (n, P)."""
        lower = self.factor.lower
        return self.prior.mean(self.rows) + weighted_sum(lower, weighted_sum(lower.T, self.weights))

    def left_out(self, rows: Tensor | None = None) -> MeanVariance:
        """See `Posterior`."""
        residual, variance = self.left_out_residuals(rows)
        values = self.given_values() if rows is None else self.given_values()[rows]
        return MeanVariance(values - residual, variance)

    def left_out_residuals(self, rows: Tensor | None = None) -> LeftOutErrors:
        """Return what all other rows miss of each (n, P), or of some (m,), and its variance."""
        if rows is None:
            return left_out_residuals(self.factor.precision, self.weights)
        return left_out_residuals(self.factor.precision_of(rows), self.weights[rows])

    @torch.no_grad()
    def covariance(self, queries: Tensor) -> Tensor:
        """Return the covariance (B, B) of the signal at places (B, D), in the kernel's units."""
        cross = self.cross_covariance(queries, self.prior.columns(queries))
        white = self.factor.whiten(cross.T)
        return self.prior.kernel.amplitude * (self.prior.cross_covariance(queries, queries) - white.T @ white)


def _factor(prior: Prior, places: Tensor, extra: Tensor) -> Factor:
    gram = places.new_zeros(len(places), len(places))
    for start in range(0, len(places), BLOCK):
        part = slice(start, start + BLOCK)
        # One triangle, all that a factor reads, in blocks that stay in the processor's caches.
        gram[part, : start + BLOCK] = prior.cross_covariance(places[part], places[: start + BLOCK])
    gram.diagonal().add_(prior.kernel.noise + extra)
    return Factor.from_gram(gram, "raise", overwrite=True)


def approximation_label(name: str, posterior: Posterior | None) -> str:
    """Return a method's name with how its process is approximated, where it is."""
    how = None if posterior is None else posterior.approximation
    return name if how is None else f"{name} ({how})"

"""A process conditioned on rows: exactly, or each query on the rows nearest to it.

Many outputs share one covariance. Variances are of a measurement, its noise included, in units of the
kernel's amplitude.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsparc.processes.conditioned import weighted
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import apart
from gsparc.processes.left_out import left_out
from gsparc.processes.prior import Prior


@dataclass(frozen=True)
class Answer:
    """What is said of B places.

    Attributes:
        mean: (B, P) float64 or complex128.
        left: (B,) variance of a measurement.
    """

    mean: Tensor
    left: Tensor


class Posterior(ABC):
    """What rows say; see `Exact` and `gsparc.processes.nearest.Nearest`."""

    approximation: ClassVar[str | None] = None  # how, where it is not exact
    prior: Prior

    @property
    @abstractmethod
    def places(self) -> Tensor:
        """Of the rows (n, D) float64 [m]."""

    @abstractmethod
    def answer(self, queries: Tensor) -> Answer:
        """Of places (B, D) float64 [m]."""

    @abstractmethod
    def mean_at(self, queries: Tensor) -> Tensor:
        """The mean alone (B, P), with autograd for places (B, D) float64 [m]."""

    @abstractmethod
    def left_out(self) -> tuple[Tensor, Tensor]:
        """Mean (n, P) and variance of a measurement (n,) at each row's place without its own."""

    @abstractmethod
    def distance(self, queries: Tensor) -> Tensor:
        """From places (B, D) to the nearest row (B,) [m]."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Tensors and numbers that `read` needs."""

    @cached_property
    def extent(self) -> float:
        """Diagonal of the rows' places [m]."""
        size = self.places.amax(0) - self.places.amin(0)
        return float(torch.linalg.vector_norm(size))


@dataclass(frozen=True)
class Exact(Posterior):
    """Given n rows with one factor.

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
    def of(
        cls,
        prior: Prior,
        places: Tensor,
        values: Tensor,
        extra: Tensor | None = None,
        factor: Factor | None = None,
    ) -> Exact:
        """Of values (n, P) at places (n, D) float64 [m]; their covariance's factor where it is known."""
        extra = torch.zeros(len(places), dtype=torch.float64) if extra is None else extra
        factor = _factor(prior, places, extra) if factor is None else factor
        found = cls(prior, places, factor.solved(values - prior.mean(places)), extra)
        found.__dict__["factor"] = factor  # as `cached_property` would keep it
        return found

    def given(self, places: Tensor, values: Tensor) -> Exact:
        """The same given more rows (m, D), (m, P), in m n^2 instead of (n + m)^3 operations."""
        cross = self.prior.between(self.rows, places)
        own = self.prior.between(places, places)
        own.diagonal().add_(self.prior.kernel.noise)
        extra = torch.cat([self.extra, torch.zeros(len(places), dtype=torch.float64)])
        every, rows = torch.cat([self.values(), values]), torch.cat([self.rows, places])
        return Exact.of(self.prior, rows, every, extra, self.factor.bordered(cross, own))

    def without(self, rows: Tensor) -> Exact:
        """The same without rows (m,) by their numbers."""
        kept = torch.ones(len(self.rows), dtype=torch.bool).index_fill(0, rows, False)
        return Exact.of(self.prior, self.rows[kept], self.values()[kept], self.extra[kept])

    @property
    def places(self) -> Tensor:
        """See `Posterior`."""
        return self.rows

    @cached_property
    def factor(self) -> Factor:
        """Of the rows' covariance."""
        return _factor(self.prior, self.rows, self.extra)

    @torch.no_grad()
    def answer(self, queries: Tensor) -> Answer:
        """See `Posterior`."""
        own = self.prior.columns(queries)
        cross, prior = self._cross(queries, own), self.prior.variance(own)
        known = self.factor.whitened(cross.T).square().sum(0)
        return Answer(self._mean(queries, cross), (prior - known).clamp_min(0.0).minimum(prior))

    def mean_at(self, queries: Tensor) -> Tensor:
        """See `Posterior`."""
        return self._mean(queries, self._cross(queries, self.prior.columns(queries)))

    def distance(self, queries: Tensor) -> Tensor:
        """See `Posterior`."""
        return apart(queries, self.rows).amin(1)

    def _mean(self, queries: Tensor, cross: Tensor) -> Tensor:
        found = weighted(cross, self.weights)
        return found if self.prior.trend is None else self.prior.mean(queries) + found

    def _cross(self, queries: Tensor, own: Tensor) -> Tensor:
        found = self.prior.kernel.between(queries, self.rows)
        return found if self.prior.trend is None else found.addmm(own, self._columns.T)

    @cached_property
    def _columns(self) -> Tensor:
        return self.prior.columns(self.rows)

    def values(self) -> Tensor:
        """What it was given (n, P)."""
        lower = self.factor.lower
        return self.prior.mean(self.rows) + weighted(lower, weighted(lower.T, self.weights))

    def left_out(self) -> tuple[Tensor, Tensor]:
        """See `Posterior`."""
        residual, variance = self.residual()
        return self.values() - residual, variance

    def residual(self) -> tuple[Tensor, Tensor]:
        """What all other rows miss of each (n, P), and its variance (n,)."""
        return left_out(self.factor.precision, self.weights)

    @torch.no_grad()
    def covariance(self, queries: Tensor) -> Tensor:
        """(B, B) of the signal at places (B, D), in the kernel's units."""
        cross = self._cross(queries, self.prior.columns(queries))
        white = self.factor.whitened(cross.T)
        return self.prior.kernel.amplitude * (self.prior.between(queries, queries) - white.T @ white)

    def state(self) -> dict[str, Any]:
        """See `Posterior`."""
        return {**self.prior.state(), "places": self.rows, "weights": self.weights, "extra": self.extra}

    @classmethod
    def read(cls, state: dict[str, Any]) -> Exact:
        """The posterior whose `state()` this was."""
        return cls(Prior.read(state), state["places"], state["weights"], state["extra"])


def _factor(prior: Prior, places: Tensor, extra: Tensor) -> Factor:
    gram = prior.between(places, places)
    gram.diagonal().add_(prior.kernel.noise + extra)
    return Factor.of(gram, "raise")


def approximated(name: str, posterior: Posterior | None) -> str:
    """A method's name with how its process is approximated, where it is."""
    how = None if posterior is None else posterior.approximation
    return name if how is None else f"{name} ({how})"

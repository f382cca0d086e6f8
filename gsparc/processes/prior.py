"""What is known of values before any row (`Prior`), and what rows say of other places (`Posterior`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from gsparc.processes.averages import MeanVariance
from gsparc.processes.kernel import Kernel
from gsparc.processes.stored import Stored
from gsparc.processes.trend import Trend


@dataclass(frozen=True)
class Prior(Stored):
    """`trend + process of the kernel`; covariances are relative to the kernel's amplitude.

    Attributes:
        kernel: of places; its noise is that of one measurement.
        trend: mean and columns of terms with unit normal weights; None: mean 0.
    """

    kernel: Kernel
    trend: Trend | None = None

    @property
    def known_trend(self) -> Trend:
        """The trend, where there is one."""
        assert self.trend is not None
        return self.trend

    def mean(self, places: Tensor) -> Tensor:
        """Return the mean (n, 1) at places (n, D) [m]."""
        return places.new_zeros(len(places), 1) if self.trend is None else self.trend.mean(places)[:, None]

    def columns(self, places: Tensor) -> Tensor:
        """Return terms (n, Q) at places (n, D) [m]."""
        return places.new_zeros(len(places), 0) if self.trend is None else self.trend.columns(places)

    def mean_and_columns(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return `mean` and `columns` at once, which may have much in common."""
        if self.trend is None:
            return self.mean(places), self.columns(places)
        mean, columns = self.trend.mean_and_columns(places)
        return mean[:, None], columns

    def cross_covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the covariance (n, m) of values at places (n, D) and (m, D) [m], without noise."""
        result = self.kernel.correlations(a, b)
        return result if self.trend is None else result.addmm(self.columns(a), self.columns(b).T)

    def variance(self, columns: Tensor) -> Tensor:
        """Return the variance of a measurement (n,) at places of terms (n, Q)."""
        # Weights of columns have unit variance, and so has the kernel.
        return columns.square().sum(1) + (1 + self.kernel.noise)


class Posterior(Stored, ABC):
    """See `gsparc.processes.posterior.Exact` and `gsparc.processes.nearest.Nearest`."""

    approximation: ClassVar[str | None] = None  # how, where it is not exact
    prior: Prior

    @property
    @abstractmethod
    def places(self) -> Tensor:
        """Places of the rows (n, D) float64 [m]."""

    @abstractmethod
    def answer(self, queries: Tensor, float64: bool = False) -> MeanVariance:
        """Return mean (B, P) and variance of a measurement (B,) at places (B, D) float64 [m], with autograd.

        Which rows are nearest has no gradient.

        Values of very many rows may be float32, and means with them; `float64`: they are made so.
        """

    @abstractmethod
    def mean_at(self, queries: Tensor, float64: bool = False) -> Tensor:
        """Return the mean alone (B, P), as `answer` has it."""

    @abstractmethod
    def left_out(self, rows: Tensor | None = None) -> MeanVariance:
        """Return the mean (n, P) and variance of a measurement (n,) at each row's place without its own.

        Of some `rows` (m,) by their numbers, or of all.
        """

    @abstractmethod
    def nearest_distance(self, queries: Tensor) -> Tensor:
        """Return distances (B,) [m] from places (B, D) to the nearest row."""

    @cached_property
    def extent(self) -> float:
        """Diagonal of the rows' places [m]."""
        size = self.places.amax(0) - self.places.amin(0)
        return float(torch.linalg.vector_norm(size))

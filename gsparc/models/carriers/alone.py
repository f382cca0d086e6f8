"""Processes of each carrier alone: one over all would only smooth what carriers do not share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from gsparc.processes.averages import MeanVariance
from gsparc.processes.fit_kernel import choose_left_out_kernel
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior
from gsparc.processes.stored import Stored

LEAST_ROWS = 4  # of a carrier, that tell a process of its own


@dataclass(frozen=True)
class CarriersAlone(Stored):
    """A mean and a process of images for each carrier with rows enough.

    Attributes:
        means: (T, P) float64.
        processes: (T,) of what carriers are about their means; None without rows.
    """

    means: Tensor
    processes: tuple[Exact | None, ...]

    @classmethod
    def learn(
        cls, places: Tensor, values: Tensor, station: Tensor, count: int, entries: int
    ) -> Self:
        """Choose kernels and condition on rows.

        Args:
            places: (n, 3) float64 [m].
            values: (n, P) float64, components of images of so many `entries`.
            station: (n,) which of the `count` carriers.
            count: of carriers.
            entries: pixels.
        """
        priors: list[Prior | None] = [None] * count
        for number in (
            (torch.bincount(station, minlength=count) >= LEAST_ROWS).nonzero()[:, 0].tolist()
        ):
            own = station == number
            centred = values[own] - values[own].mean(0)
            kernel = choose_left_out_kernel(places[own].numpy(), centred.numpy(), entries)
            priors[number] = Prior(kernel)
        return cls._from_priors(priors, places, values, station)

    def condition(self, places: Tensor, values: Tensor, station: Tensor) -> Self:
        """Return the same kernels conditioned on rows; see `learn`."""
        priors = [None if process is None else process.prior for process in self.processes]
        return self._from_priors(priors, places, values, station)

    @classmethod
    def _from_priors(
        cls, priors: Sequence[Prior | None], places: Tensor, values: Tensor, station: Tensor
    ) -> Self:
        means, processes = values.new_zeros(len(priors), values.shape[1]), list[Exact | None]()
        for number, prior in enumerate(priors):
            own = station == number
            means[number] = values[own].mean(0) if prior else 0.0
            centred = values[own] - means[number]
            processes.append(
                None if prior is None else Exact.from_values(prior, places[own], centred)
            )
        return cls(means, tuple(processes))

    def add_unknown(self) -> Self:
        """Return these and, last, a carrier without rows."""
        means = torch.cat([self.means, torch.zeros_like(self.means[:1])])
        return replace(self, means=means, processes=(*self.processes, None))

    def left_out(self, station: Tensor) -> Tensor:
        """Return what other rows, and their mean, miss of each that it was conditioned on (n, P);
        NaN without a process.
        """
        result = torch.full((len(station), self.means.shape[1]), torch.nan, dtype=torch.float64)
        for number, process in enumerate(self.processes):
            if process is not None:
                residual = process.left_out_residuals().residual
                alike = process.factor.solve(torch.ones_like(residual[:, :1]))
                missed = alike / process.factor.precision[:, None]  # of a mean that is off by 1
                away = process.given_values() / (len(residual) - 1)  # that a row takes the mean
                result[station == number] = residual + missed * away
        return result

    def has_process(self, station: Tensor) -> Tensor:
        """Return which of these carriers (n,) have one, bool."""
        return torch.tensor([process is not None for process in self.processes])[station]

    def answer(self, places: Tensor, station: Tensor) -> MeanVariance:
        """Return values (n, P) at places (n, 3), and variances (n,) per pixel;
        NaN without a process.
        """
        mean = places.new_full((len(places), self.means.shape[1]), torch.nan)
        variance = places.new_full((len(places),), torch.nan)
        for number in station.unique().tolist():
            process, own = self.processes[number], station == number
            if process is not None:
                answer = process.answer(places[own], float64=True)
                mean[own] = self.means[number] + answer.mean
                variance[own] = process.prior.kernel.amplitude * answer.variance
        return MeanVariance(mean, variance)

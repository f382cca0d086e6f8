"""Processes of each carrier alone: one over all would only smooth what carriers do not share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from gsparc.processes.averages import MeanVariance
from gsparc.processes.fit_kernel import choose_left_out_kernel
from gsparc.processes.kernel import Kernel
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
    def learn(cls, places: Tensor, values: Tensor, station: Tensor, count: int, entries: int) -> Self:
        """Choose kernels and condition on rows.

        Args:
            places: (n, 3) float64 [m].
            values: (n, P) float64, components of images of so many `entries`.
            station: (n,) which of the `count` carriers.
            count: of carriers.
            entries: pixels.
        """
        kernels: list[Kernel | None] = []
        for number in range(count):
            own = values[station == number]
            if len(own) < LEAST_ROWS:
                kernels.append(None)
                continue
            centred = (own - own.mean(0)).numpy()
            kernels.append(choose_left_out_kernel(places[station == number].numpy(), centred, entries))
        none = values.new_zeros(0, values.shape[1])
        start = (None if one is None else Exact.from_values(Prior(one), places[:0], none) for one in kernels)
        return cls(values.new_zeros(count, values.shape[1]), tuple(start)).condition(places, values, station)

    def condition(self, places: Tensor, values: Tensor, station: Tensor) -> Self:
        """Return the same kernels conditioned on rows; see `learn`."""
        means, processes = self.means.clone(), list(self.processes)
        for number, one in enumerate(processes):
            if one is not None:
                here = station == number
                means[number] = values[here].mean(0)
                processes[number] = Exact.from_values(one.prior, places[here], values[here] - means[number])
        return replace(self, means=means, processes=tuple(processes))

    def add_unknown(self) -> Self:
        """Return these and, last, a carrier without rows."""
        means = torch.cat([self.means, torch.zeros_like(self.means[:1])])
        return replace(self, means=means, processes=(*self.processes, None))

    def left_out(self, station: Tensor) -> Tensor:
        """Return what other rows miss of each that it was conditioned on (n, P); NaN without a process."""
        result = torch.full((len(station), self.means.shape[1]), torch.nan, dtype=torch.float64)
        for number, one in enumerate(self.processes):
            if one is not None:
                result[station == number] = one.left_out_residuals().residual
        return result

    def has_process(self, station: Tensor) -> Tensor:
        """Return which of these carriers (n,) have one, bool."""
        return torch.tensor([one is not None for one in self.processes])[station]

    def answer(self, places: Tensor, station: Tensor) -> MeanVariance:
        """Return values (n, P) at places (n, 3), and variances (n,) per pixel; NaN without a process."""
        mean = places.new_full((len(places), self.means.shape[1]), torch.nan)
        variance = places.new_full((len(places),), torch.nan)
        for number in station.unique().tolist():
            one, here = self.processes[number], station == number
            if one is not None:
                found = one.answer(places[here], float64=True)
                mean[here] = self.means[number] + found.mean
                variance[here] = one.prior.kernel.amplitude * found.variance
        return MeanVariance(mean, variance)

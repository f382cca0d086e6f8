"""What is known of values before any row: a mean law, its uncertain terms, and a kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from gsparc.processes.kernel import Kernel, WaveKernel
from gsparc.processes.trend import Trend, trend_of


@dataclass(frozen=True)
class Prior:
    """`trend + process of the kernel`; covariances are relative to the kernel's amplitude.

    Attributes:
        kernel: of places; its noise is that of one measurement.
        trend: mean and columns of terms with unit normal weights; None: mean 0.
    """

    kernel: Kernel | WaveKernel
    trend: Trend | None = None

    def mean(self, places: Tensor) -> Tensor:
        """(n, 1) at places (n, D) [m]."""
        return places.new_zeros(len(places), 1) if self.trend is None else self.trend.mean(places)[:, None]

    def columns(self, places: Tensor) -> Tensor:
        """Terms (n, Q) at places (n, D) [m]."""
        return places.new_zeros(len(places), 0) if self.trend is None else self.trend.terms(places)

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Covariance (n, m) of values at places (n, D) and (m, D) [m], without noise."""
        found = self.kernel.between(a, b)
        return found if self.trend is None else found.addmm(self.columns(a), self.columns(b).T)

    def variance(self, columns: Tensor) -> Tensor:
        """Of a measurement (n,) at places of terms (n, Q)."""
        return columns.square().sum(1) + (1 + self.kernel.noise)

    def state(self) -> dict[str, Any]:
        """Numbers that `read` needs."""
        return {**self.kernel.state(), **({} if self.trend is None else self.trend.state())}

    @classmethod
    def read(cls, state: dict[str, Any]) -> Prior:
        """The prior whose `state()` this was."""
        kernel = WaveKernel.read(state) if "wave" in state else Kernel.read(state)
        return cls(kernel, trend_of(state) if "trend" in state else None)

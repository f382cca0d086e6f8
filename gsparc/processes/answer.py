"""What rows say of other places, however they are conditioned on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

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
    """See `gsparc.processes.posterior.Exact` and `gsparc.processes.nearest.Nearest`."""

    approximation: ClassVar[str | None] = None  # how, where it is not exact
    prior: Prior

    @property
    @abstractmethod
    def places(self) -> Tensor:
        """Of the rows (n, D) float64 [m]."""

    @abstractmethod
    def answer(self, queries: Tensor, exact: bool = False) -> Answer:
        """Of places (B, D) float64 [m], with autograd; which rows are nearest has no gradient.

        Values of very many rows may be float32, and means with them; `exact`: they are made float64.
        """

    @abstractmethod
    def mean_at(self, queries: Tensor, exact: bool = False) -> Tensor:
        """The mean alone (B, P), as `answer` has it."""

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

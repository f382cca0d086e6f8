"""A term of a covariance, one object in one file: what it says of two sets of rows,
and its parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, Self, TypeVar

from torch import Tensor

from gsparc.processes.stored import Stored

# What terms know of measurements: places (n, D) of powers, groups of channels
Rows = TypeVar("Rows")


class Term(Stored, ABC, Generic[Rows]):
    """One additive part of what is known of values before any row; a prior is a sum of terms.

    Numbers of a term may be floats, or tensors with gradients where they are being learned.
    """

    # Whether distances of rows are all that counts, also of both ends
    by_distance: ClassVar[bool] = False

    @abstractmethod
    def covariance(self, a: Rows, b: Rows) -> Tensor:
        """Return the covariance (n, m) of values at rows `a` (n) and `b` (m), real or complex."""

    @abstractmethod
    def parameters(self) -> Tensor:
        """Return what is learned of it (p,) float64, unbounded:
        logarithms of powers and lengths.
        """

    @abstractmethod
    def bounds(self, scale: float) -> list[tuple[float, float]]:
        """Return bounds of each parameter, for rows whose distances are about `scale` [m]."""

    @abstractmethod
    def with_values(self, parameters: Tensor) -> Self:
        """Return the term with other parameters (p,), through which gradients flow."""


class Columns(Stored, ABC):
    """A term of places (n, D) [m] that is linear in weights,
    of unit variance times the prior's deviation.

    Attributes:
        prior_db: mean and deviation of each weight of a user's term [dB of a column's unit]; None:
            0, and that of the process. A field of this name makes it a setting.
    """

    prior_db: Sequence[float] | None = None

    @abstractmethod
    def columns(self, places: Tensor) -> Tensor:
        """Return what each weight adds (n, Q) at places (n, D) [m], differentiable in these."""

    def mean(self, places: Tensor) -> Tensor:
        """Return the mean (n,) at places (n, D) [m], before any row."""
        return places.new_zeros(len(places))

"""What every term of channels says: its covariance,
and that in a basis of what places tell apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from gsparc.models.channels.columns import Slot, SlotPlaces
from gsparc.models.channels.terms.compressed import Basis
from gsparc.processes.stored import Stored
from gsparc.processes.term import Term

LOWEST, HIGHEST = -14.0, 7.0  # logarithms of powers


@dataclass(frozen=True)
class Frame(Stored):
    """What all terms of a field share.

    Attributes:
        middle: (3,) float64 [m] of the places learned from, where waves have their nominal power;
            (6,) where both ends move.
        reach: length of what is fixed [m].
        envelope, gain: lengths [m] of the diffuse field's envelope and of gains.
        offset: (3,) float64 [m] of static ends from where they are said to be.
    """

    middle: Tensor
    reach: float
    envelope: float
    gain: float
    offset: Tensor


@dataclass(frozen=True)
class ChannelTerm(Term[SlotPlaces]):
    """One term, relative to each group's scale.

    Attributes:
        name: as `ClosedForm.terms` has it; none of what is always there.
        is_signal: whether it is of the place; what is not is of training rows alone.
        is_real: whether its covariances are.
        frame: see there.
        power: (p,) float64.
    """

    name: ClassVar[str] = ""
    is_signal: ClassVar[bool] = True
    is_real: ClassVar[bool] = False
    frame: Frame
    power: Tensor

    def end_covariances(self, a: Sequence[SlotPlaces], b: Sequence[SlotPlaces]) -> Iterable[Tensor]:
        """Return covariances (n, m) of several ends of one wavelength, one by one.

        Places of all `a` differ by one displacement at most, those of `b` by the same.
        """
        return map(self.covariance, a, b)

    def variance(self, a: SlotPlaces) -> Tensor:
        """Return the variance (n,) of values at `a`."""
        return self.power.sum().expand(len(a.places))

    def unit_covariances_in_basis(self, at: SlotPlaces, basis: Basis) -> Tensor:
        """Return covariances (p, r, r) complex128 of unit powers in a basis; here of one."""
        # A logarithm of 0 is unit power.
        unit = self.with_values(self.power[:0].new_zeros(1))
        return basis.compress(unit.covariance(at, at))[None]

    def design(self, slot: Slot) -> Tensor:
        """Return how logarithms of an end's own powers depend on `parameters` (p, q), linearly."""
        return torch.eye(len(self.power), dtype=torch.float64)

    def parameters(self) -> Tensor:
        """Return logarithms of powers (p,), see `Term`."""
        return self.power.log()

    def with_values(self, parameters: Tensor) -> Self:
        """Return the term of other logarithms, see `Term`."""
        return replace(self, power=parameters.exp())

    def bounds(self, scale: float = 1.0) -> list[tuple[float, float]]:
        """Return bounds of logarithms, see `Term`."""
        return [(LOWEST, HIGHEST)] * len(self.power)

    def penalty(self, parameters: Tensor, shrinkage: float) -> Tensor:
        """Return () minus the logarithm of a prior of the parameters,
        in which `shrinkage` rows count.
        """
        return torch.zeros((), dtype=torch.float64)

    @property
    def count_learned(self) -> int:
        """Numbers that are learned for it."""
        return len(self.parameters())

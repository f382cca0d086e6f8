"""Waves from everywhere alike: `p E sinc(k d)`, with E the Matern-3/2 envelope."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat

from torch import Tensor

from gsparc.models.channels.columns import SlotPlaces
from gsparc.models.channels.kernels import isotropic_correlation
from gsparc.models.channels.terms.compressed import Basis
from gsparc.models.channels.terms.term import ChannelTerm


@dataclass(frozen=True)
class Isotropic(ChannelTerm):
    """The diffuse field, or what all its directions have in common."""

    name = "residual"
    is_real = True

    def correlation(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return the covariance (n, m) float64 of unit power."""
        return isotropic_correlation(a.places, b.places, a.slot.wavenumber, self.frame.envelope)

    def covariance(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return `p E sinc(k d)` (n, m) float64, see `Term`."""
        return self.power * self.correlation(a, b)

    def end_covariances(self, a: Sequence[SlotPlaces], b: Sequence[SlotPlaces]) -> Iterable[Tensor]:
        """Return the same for each, see `ChannelTerm`."""
        return repeat(self.covariance(a[0], b[0]), len(a))

    def unit_covariances_in_basis(self, at: SlotPlaces, basis: Basis) -> Tensor:
        """Return the one, see `ChannelTerm`."""
        return basis.compress_once("isotropic", lambda: [self.correlation(at, at)])

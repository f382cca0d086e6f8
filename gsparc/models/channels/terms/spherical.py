"""Spherical waves: `R sum_n p_n a_n a_n^H + S sum_n s_n a_n a_n^H`.

R and S are squared exponentials of gains: one that only ends far outside,
and one of gains that vary.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import Slot, SlotPlaces
from gsparc.models.channels.kernels import spherical_wave, squared_exponential
from gsparc.models.channels.terms.compressed import Basis
from gsparc.models.channels.terms.term import ChannelTerm
from gsparc.processes.kernel import distances


@dataclass(frozen=True)
class Spherical(ChannelTerm):
    """W waves; powers (2W,) of their fixed gains, then of those that vary."""

    @abstractmethod
    def sources(self, slot: Slot) -> Tensor:
        """Return where waves come from (W, 3) [m]."""

    def source_distances(self, slot: Slot) -> Tensor:
        """Return distances (W,) [m] from sources to the places' middle."""
        return torch.linalg.vector_norm(self.sources(slot) - self.frame.middle, dim=-1)

    def waves(self, at: SlotPlaces) -> Tensor:
        """Return each wave (W, n) complex128, of size 1 in the middle."""
        sources, wavenumber = self.sources(at.slot), at.slot.wavenumber
        both = zip(
            sources, torch.linalg.vector_norm(sources - self.frame.middle, dim=-1), strict=True
        )
        return torch.stack(
            [spherical_wave(at.places, source, wavenumber, away) for source, away in both]
        )

    @property
    def split_powers(self) -> tuple[Tensor, Tensor]:
        """Powers (W,) of fixed gains, and of those that vary."""
        # In the order of `unit_covariances_in_basis`: fixed gains of all waves, then varying ones.
        fixed, varying = self.power.view(2, -1)
        return fixed, varying

    def covariance(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return that of all waves (n, m) complex128, see `Term`."""
        distance, before, after = distances(a.places, b.places), self.waves(a), self.waves(b)
        fixed, varying = ((before.T * power) @ after.conj() for power in self.split_powers)
        return fixed * squared_exponential(
            distance, self.frame.reach
        ) + varying * squared_exponential(distance, self.frame.gain)

    def variance(self, a: SlotPlaces) -> Tensor:
        """Return that of all waves (n,), see `ChannelTerm`."""
        return self.power.view(2, -1).sum(0) @ self.waves(a).abs().square()

    def unit_covariances_in_basis(self, at: SlotPlaces, basis: Basis) -> Tensor:
        """Return those of fixed gains, then of those that vary, see `ChannelTerm`."""
        waves, away, frame = self.waves(at), distances(at.places, at.places), self.frame
        each = [wave[:, None] * wave.conj() for wave in waves]
        gains = [squared_exponential(away, length) for length in (frame.reach, frame.gain)]
        return torch.stack(
            [basis.compress(covariance * gain) for gain in gains for covariance in each]
        )

"""The direct wave of a static end, or between two ends that move: `R p a a^H + S s a a^H`.

R and S are squared exponentials of gains: one that only ends far outside, and one of gains that vary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import At, Slot
from gsparc.models.channels.kernels import smooth, steering
from gsparc.models.channels.terms.compressed import Basis, Piece
from gsparc.models.channels.terms.term import ChannelTerm
from gsparc.processes.kernel import apart


@dataclass(frozen=True)
class Direct(ChannelTerm):
    """One spherical wave; powers (2,) of its fixed gain, then of one that varies."""

    name = "direct"

    def away(self, slot: Slot) -> Tensor:
        """Return the distance () [m] from the end to the places' middle."""
        return torch.linalg.vector_norm(slot.end + self.frame.offset - self.frame.middle)

    def wave(self, at: At) -> Tensor:
        """Return it (n,) complex128, of size 1 in the middle; of places (n, 6), from one end to the other."""
        wavenumber = at.slot.wavenumber
        if at.places.shape[1] == 3:
            return steering(at.places, at.slot.end + self.frame.offset, wavenumber, self.away(at.slot))
        middle = self.frame.middle[:3] - self.frame.middle[3:]
        away = torch.linalg.vector_norm(middle).clamp_min(2 * math.pi / wavenumber)
        between = at.places[:, :3] - at.places[:, 3:]
        return steering(between, torch.zeros_like(middle), wavenumber, away)

    def covariance(self, a: At, b: At) -> Tensor:
        """Return that of both gains (n, m) complex128, see `Term`."""
        distance, (fixed, varying) = apart(a.places, b.places), self.power
        gains = fixed * smooth(distance, self.frame.reach) + varying * smooth(distance, self.frame.gain)
        return gains * (self.wave(a)[:, None] * self.wave(b).conj())

    def variance(self, a: At) -> Tensor:
        """Return that of both gains (n,), see `Term`."""
        return self.power.sum() * self.wave(a).abs().square()

    def pieces(self, at: At, basis: Basis) -> tuple[Piece, ...]:
        """Return that of the fixed gain, then of the one that varies, see `ChannelTerm`."""
        wave, frame = self.wave(at)[None], self.frame
        return basis.factored(frame.reach, wave) + basis.factored(frame.gain, wave)

    @property
    def worth(self) -> int:
        """Powers, the gain's length, and the offset where there is one."""
        return 3 + 3 * bool(self.frame.offset.any())

"""What does not depend on the place: `R p`, with R a squared exponential that only ends far outside."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import At
from gsparc.models.channels.kernels import smooth
from gsparc.models.channels.terms.compressed import Basis, Piece
from gsparc.models.channels.terms.term import ChannelTerm
from gsparc.processes.kernel import apart


@dataclass(frozen=True)
class Leakage(ChannelTerm):
    """A constant of each group."""

    name = "leakage"
    is_real = True

    def covariance(self, a: At, b: At) -> Tensor:
        """Return `R p` (n, m) float64, see `Term`."""
        return self.power * smooth(apart(a.places, b.places), self.frame.reach)

    def pieces(self, at: At, basis: Basis) -> tuple[Piece, ...]:
        """Return the one, see `ChannelTerm`."""
        return basis.factored(self.frame.reach, torch.ones(1, len(at.places), dtype=torch.complex128))

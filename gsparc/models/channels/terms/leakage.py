"""What does not depend on the place: `R p`,
with R a squared exponential that only ends far outside.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsparc.models.channels.columns import SlotPlaces
from gsparc.models.channels.kernels import squared_exponential
from gsparc.models.channels.terms.term import ChannelTerm
from gsparc.processes.kernel import distances


@dataclass(frozen=True)
class Leakage(ChannelTerm):
    """A constant of each group."""

    name = "leakage"
    is_real = True

    def covariance(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return `R p` (n, m) float64, see `Term`."""
        return self.power * squared_exponential(distances(a.places, b.places), self.frame.reach)

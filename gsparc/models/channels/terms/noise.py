"""White noise of training rows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import SlotPlaces
from gsparc.models.channels.terms.term import ChannelTerm


@dataclass(frozen=True)
class Noise(ChannelTerm):
    """`p` at each row alone."""

    is_signal = False
    is_real = True

    def covariance(self, a: SlotPlaces, b: SlotPlaces) -> Tensor:
        """Return the diagonal (n, m) float64 of rows with themselves, 0 with others; see `Term`."""
        alike = torch.zeros(len(a.places), len(b.places), dtype=torch.float64)
        return self.power * (alike.fill_diagonal_(1.0) if a is b else alike)

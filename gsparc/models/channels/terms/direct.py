"""The direct wave of a static end, or between two ends that move."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import At, Slot
from gsparc.models.channels.kernels import steering
from gsparc.models.channels.terms.spherical import Spherical


@dataclass(frozen=True)
class Direct(Spherical):
    """One spherical wave."""

    name = "direct"

    def sources(self, slot: Slot) -> Tensor:
        """Return the end (1, 3) [m], see `Spherical`."""
        return (slot.end + self.frame.offset)[None]

    def waves(self, at: At) -> Tensor:
        """Return the wave (1, n), see `Spherical`; of places (n, 6), from one end to the other."""
        if at.places.shape[1] == 3:
            return super().waves(at)
        middle, wavenumber = self.frame.middle[:3] - self.frame.middle[3:], at.slot.wavenumber
        away = torch.linalg.vector_norm(middle).clamp_min(2 * math.pi / wavenumber)
        between = at.places[:, :3] - at.places[:, 3:]
        return steering(between, torch.zeros_like(middle), wavenumber, away)[None]

    @property
    def worth(self) -> int:
        """Powers, the gain's length, and the offset where there is one."""
        return 3 + 3 * bool(self.frame.offset.any())

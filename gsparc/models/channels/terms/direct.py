"""The direct wave of a static end, or between two ends that move."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.channels.columns import Slot, SlotPlaces
from gsparc.models.channels.kernels import spherical_wave
from gsparc.models.channels.terms.spherical import Spherical
from gsparc.processes.places import first_end, has_both_ends, other_end


@dataclass(frozen=True)
class Direct(Spherical):
    """One spherical wave."""

    name = "direct"

    def sources(self, slot: Slot) -> Tensor:
        """Return the end (1, 3) [m], see `Spherical`."""
        return (slot.end + self.frame.offset)[None]

    def waves(self, at: SlotPlaces) -> Tensor:
        """Return the wave (1, n), see `Spherical`; of places (n, 6), from one end to the other."""
        if not has_both_ends(at.places):
            return super().waves(at)
        middle, wavenumber = (
            first_end(self.frame.middle) - other_end(self.frame.middle),
            at.slot.wavenumber,
        )
        away = torch.linalg.vector_norm(middle).clamp_min(2 * math.pi / wavenumber)
        between = first_end(at.places) - other_end(at.places)
        return spherical_wave(between, torch.zeros_like(middle), wavenumber, away)[None]

    @property
    def count_learned(self) -> int:
        """Powers, the gain's length, and the offset where there is one."""
        offset = self.frame.offset
        return len(self.power) + 1 + len(offset) * bool(offset.any())

"""Images of static ends in mirror planes that all ends share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from gsparc.models.channels.columns import Slot, SlotPlaces
from gsparc.models.channels.terms.spherical import Spherical
from gsparc.models.channels.terms.term import Frame
from gsparc.physics.mirror_planes import images


@dataclass(frozen=True, kw_only=True)
class Images(Spherical):
    """One image of each end in each of `planes` (W, 4) float64, see `physics.mirror_planes`."""

    name = "mirrors"
    planes: Tensor

    @classmethod
    def from_planes(cls, frame: Frame, planes: Tensor, level: float = 1.0) -> Self:
        """Return images of equal powers."""
        return cls(frame, torch.full((2 * len(planes),), level, dtype=torch.float64), planes=planes)

    def mirror_ends(self, ends: Tensor) -> Tensor:
        """Return images (..., W, 3) [m] of ends (..., 3) where these are said to be."""
        return images(
            ends + self.frame.offset, self.planes, [(n,) for n in range(len(self.planes))]
        )

    def sources(self, slot: Slot) -> Tensor:
        """Return the images (W, 3) [m], see `Spherical`."""
        return self.mirror_ends(slot.end)

    def waves(self, at: SlotPlaces) -> Tensor:
        """Return waves (W, n), see `Spherical`; 0 of planes that have the end
        and the middle on two sides.
        """
        both = torch.stack([at.slot.end + self.frame.offset, self.frame.middle], 1)
        sides = self.planes[:, :-1] @ both - self.planes[:, -1:]
        # A mirror reflects to the side that it is lit from.
        return super().waves(at) * (sides[:, :1] * sides[:, 1:] > 0)

    @property
    def count_learned(self) -> int:
        """Powers and planes."""
        return len(self.power) + self.planes[:, :-1].numel()

"""How many known walls and floors the straight path between two ends crosses.

The multi-wall model (COST Action 231, "Digital mobile radio towards future generation systems", final report,
1999, section 4.7.2): one loss for each wall, another for each floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LEVEL = 0.7  # upward part of a floor's normal


@dataclass(frozen=True)
class Walls:
    """Q rectangles, boxes as six each.

    Attributes:
        axes: (Q, 3, 3) float64, of each its normal and two tangents.
        corners: (Q, 3) lowest coordinates along these [m].
        sizes: (Q, 2) along the tangents [m].
        still: (3,) the end that stands [m]; (0,) where both move.
    """

    axes: Tensor
    corners: Tensor
    sizes: Tensor
    still: Tensor

    def crossed(self, places: Tensor) -> Tensor:
        """How many walls and floors (n, 2) lie on paths to places (n, 3), or between both ends (n, 6) [m]."""
        other = self.still.expand(len(places), 3) if len(self.still) else places[:, 3:]
        start, end = (
            (at @ self.axes.flatten(0, 1).T).view(len(places), -1, 3) - self.corners
            for at in (places[:, :3], other)
        )
        apart = (start - end)[..., :1]
        met = start + start[..., :1] / torch.where(apart == 0, 1.0, apart) * (end - start)
        inside = ((met[..., 1:] >= 0) & (met[..., 1:] <= self.sizes)).all(-1)
        hit = (inside & (start[..., 0] * end[..., 0] < 0)).to(places)
        level = self.axes[:, 0, 2].abs() > LEVEL
        return torch.stack([hit[:, ~level].sum(1), hit[:, level].sum(1)], 1)

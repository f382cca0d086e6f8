"""Loss that grows with the length of a path through a convex polygon of trees."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.processes.term import Columns


@dataclass(frozen=True)
class Trees(Columns):
    """Straight paths lose in a polygon as many decibels a metre as rows say.

    Attributes:
        corners: (k, 2) of a convex polygon, counterclockwise [m].
        prior_db: mean and deviation of the loss before any row [dB a metre].
    """

    corners: list[list[float]]
    prior_db: tuple[float, float] = (0.0, 0.5)

    def columns(self, places: Tensor) -> Tensor:
        """Return the lengths inside (n, 1), clipped edge by edge (M. Cyrus, J. Beck 1978)."""
        corners, (end, start) = places.new_tensor(self.corners), places.split(3, 1)
        way = end - start
        enters, leaves = torch.zeros_like(way[:, 0]), torch.ones_like(way[:, 0])
        for corner, edge in zip(corners, corners.roll(-1, 0) - corners, strict=True):
            inwards = torch.stack([-edge[1], edge[0]])
            gap = (start[:, :2] - corner) @ inwards  # below 0: outside
            slope = way[:, :2] @ inwards
            met = -gap / torch.where(slope == 0, 1.0, slope)
            enters = torch.where(slope > 0, enters.maximum(met), enters)
            leaves = torch.where(slope < 0, leaves.minimum(met), leaves)
            leaves = torch.where((slope == 0) & (gap < 0), 0.0, leaves)
        inside = (leaves - enters).clamp_min(0.0) * torch.linalg.vector_norm(way, dim=1)
        return inside[:, None]

"""A map from before any row (`model.prior`): of a planning tool, a ray tracer, or last year's model.

Levels are a share of the map's, which is about 1 before any row, a constant, and a process of what the map
lacks. Laws without the map stand beside it, and the likelihood of rows left out says which is right
(`candidate_priors` in `settings.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.processes.term import Columns

SHARE = (1.0, 0.3)  # mean and deviation of the weight of a map's levels
NEAR = 4  # points of the map that tell of a place
CLOSE = 1e-3  # [m]


@dataclass(frozen=True)
class PriorMap(Columns):
    """Levels of a map, between its points the mean of the nearest, weighed by distances to the power -2.

    Attributes:
        points: (M, 2) of the end that moves [m], world.
        level: (M,) there, less their mean [dB].
        prior_db: see `Columns`.
    """

    points: Tensor
    level: Tensor
    prior_db: Sequence[float] | None = SHARE

    @classmethod
    def from_levels(cls, points: np.ndarray, level: np.ndarray) -> Self:
        """Return a map of levels (M,) [dB] at points (M, 2) [m]."""
        return cls(torch.from_numpy(points.copy()), torch.from_numpy(level - level.mean()))

    @cached_property
    def _tree(self) -> cKDTree:
        """Of the points: made once, since each query asks it."""
        return cKDTree(self.points.numpy())

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`."""
        at = places[:, :2]
        near = self._tree.query(at.detach().numpy(), min(NEAR, len(self.points)))[1]
        near = torch.from_numpy(near.reshape(len(at), -1))
        weight = 1 / ((self.points[near] - at[:, None]).square().sum(2) + CLOSE**2)
        return ((weight * self.level[near]).sum(1) / weight.sum(1))[:, None].to(places.dtype)

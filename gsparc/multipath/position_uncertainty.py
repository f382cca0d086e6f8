"""What a source's place that is known only to within a covariance leaves of its coherence.

To receivers far apart a source at an uncertain place has an unknown phase. Averaged over a place with
covariance S, what receivers in directions u and u' hear of it has the covariance of a sharp source times

    exp(-|L^T (v - v')|^2 / 2),   v = 2 pi f u / c,   S = L L^T .
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gsparc.physics.waves import LIGHT

SHARP_RAD = 0.1  # standard deviation of relative phases below which a place counts as exact


@dataclass(frozen=True)
class Open:
    """K sources whose places are known to within covariances.

    Attributes:
        points: (K, 3) float64 [m].
        covariance: (K, 3, 3) float64 [m^2].
    """

    points: Tensor
    covariance: Tensor

    @cached_property
    def lower(self) -> Tensor:
        """(K, 3, 3), Cholesky factors of the covariances."""
        return torch.linalg.cholesky(self.covariance + 1e-14 * torch.eye(3, dtype=torch.float64))

    def turns(self, places: Tensor, frequency: Tensor) -> Tensor:
        """(K, n, 3) float32 [rad], `L^T v` for places (n, 3) [m] and frequencies (n,) or () [Hz]."""
        slope = slopes(self.points, places, frequency)
        return (slope @ self.lower).float()

    def only(self, kept: Tensor) -> Open:
        """Some of the sources."""
        return Open(self.points[kept], self.covariance[kept])

    def blurred(self, places: Tensor, frequency: Tensor) -> Tensor:
        """Numbers of the sources that are not sharp to these places."""
        turns = self.turns(places, frequency)
        spread = (turns - turns.mean(1, keepdim=True)).square().sum(-1).amax(1).sqrt()
        return torch.nonzero(spread > SHARP_RAD).flatten()


def slopes(points: Tensor, places: Tensor, frequency: Tensor) -> Tensor:
    """(K, n, 3) float64 [rad/m], how fast phases that places receive turn with the points, up to a sign."""
    towards = points[:, None] - places[None]
    away = torch.linalg.vector_norm(towards, dim=-1, keepdim=True).clamp_min(1e-3)
    hertz = torch.as_tensor(frequency, dtype=torch.float64).reshape(-1, 1)
    return towards / away * (2 * math.pi / LIGHT * hertz)


def coherence(first: Tensor, second: Tensor) -> Tensor:
    """(K, m, n) float32, of `turns` (K, m, 3) and (K, n, 3)."""
    # differences of products would lose what keeps covariances positive definite
    apart = torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")
    return apart.square_().mul_(-0.5).exp_()

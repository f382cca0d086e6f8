"""Loss of coherence between receivers by uncertainty of a source's position.

A source at an uncertain position has an unknown relative phase at receivers far apart. Averaged over a
position of covariance S, signals received in directions u and u' have the covariance of a known position
times

    exp(-|L^T (v - v')|^2 / 2),   v = 2 pi f u / c,   S = L L^T .
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gsparc.physics.waves import LIGHT

SHARP_RAD = 0.1  # standard deviation of relative phases below which a position counts as exact


@dataclass(frozen=True)
class UncertainPositions:
    """K sources with Gaussian position uncertainty.

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

    def phase_vectors(self, places: Tensor, frequency: Tensor) -> Tensor:
        """(K, n, 3) float32 [rad], `L^T v` for places (n, 3) [m] and frequencies (n,) or () [Hz]."""
        slope = wave_vectors(self.points, places, frequency)
        return (slope @ self.lower).float()

    def only(self, kept: Tensor) -> UncertainPositions:
        """A subset of the sources."""
        return UncertainPositions(self.points[kept], self.covariance[kept])

    def uncertain(self, places: Tensor, frequency: Tensor) -> Tensor:
        """Indices of the sources that are not coherent over these places."""
        phase_vectors = self.phase_vectors(places, frequency)
        spread = (phase_vectors - phase_vectors.mean(1, keepdim=True)).square().sum(-1).amax(1).sqrt()
        return torch.nonzero(spread > SHARP_RAD).flatten()


def wave_vectors(points: Tensor, places: Tensor, frequency: Tensor) -> Tensor:
    """(K, n, 3) float64 [rad/m], gradients of the received phases by the sources' positions, up to a sign."""
    towards = points[:, None] - places[None]
    away = torch.linalg.vector_norm(towards, dim=-1, keepdim=True).clamp_min(1e-3)
    hertz = torch.as_tensor(frequency, dtype=torch.float64).reshape(-1, 1)
    return towards / away * (2 * math.pi / LIGHT * hertz)


def coherence(first: Tensor, second: Tensor) -> Tensor:
    """(K, m, n) float32, of `phase_vectors` (K, m, 3) and (K, n, 3)."""
    # rounding of expanded squares would make covariances indefinite
    apart = torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")
    return apart.square_().mul_(-0.5).exp_()

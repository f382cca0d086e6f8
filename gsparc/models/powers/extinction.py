"""What Gaussians take from power on the straight path between two ends: line integrals in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

POINT = 1e-6  # lengths of a path, in standard deviations, below which it is a point


@dataclass(frozen=True)
class Blockers:
    """N Gaussians that paths lose power in.

    Attributes:
        means: (N, 3) float64 [m].
        log_scales: (N, 3) of their standard deviations along their own axes, the third upwards [m].
        turns: (N,) angles from x to their first axes [rad].
    """

    means: Tensor
    log_scales: Tensor
    turns: Tensor

    @classmethod
    def none(cls) -> Blockers:
        """No Gaussians."""
        flat = torch.zeros(0, dtype=torch.float64)
        return cls(flat.view(0, 3), flat.view(0, 3), flat)

    def __len__(self) -> int:
        return len(self.means)


def line_integrals(start: Tensor, end: Tensor, means: Tensor, scales: Tensor, turns: Tensor) -> Tensor:
    """Integrals (n, N) [m] of N Gaussians of peak 1 along n segments, differentiable in all arguments.

    With the start p and the way q of a segment in a Gaussian's own axes and standard deviations, the exponent
    -|p + t q|^2 / 2 is a parabola in t: its integral over [0, 1] is a difference of error functions.

    Args:
        start, end: (n, 3) [m], the ends of the segments.
        means: (N, 3) [m].
        scales: (N, 3) standard deviations along a Gaussian's own axes, the third upwards [m].
        turns: (N,) angles from x to the first axis [rad].
    """
    way = end - start
    p = _in_axes(start[:, None] - means, turns) / scales
    q = _in_axes(way[:, None], turns) / scales
    squared = q.square().sum(-1).clamp_min(POINT**2)
    along = (p * q).sum(-1) / squared
    closest = (p.square().sum(-1) - along.square() * squared).clamp_min(0.0)
    size = squared.sqrt() / math.sqrt(2)
    within = torch.erf((1 + along) * size) - torch.erf(along * size)
    length = way.square().sum(-1).clamp_min(1e-24).sqrt()
    return length[:, None] * torch.exp(-0.5 * closest) * (0.5 * math.sqrt(math.pi)) / size * within


def extinctions(start: Tensor, end: Tensor, means: Tensor, log_scales: Tensor, turns: Tensor) -> Tensor:
    """The same in units of the shortest way through the middle: straight through a wall counts 1."""
    shortest = math.sqrt(2 * math.pi) * log_scales.amin(-1).exp()
    return line_integrals(start, end, means, log_scales.exp(), turns) / shortest


def _in_axes(vectors: Tensor, turns: Tensor) -> Tensor:
    """Vectors (n, N, 3), or (n, 1, 3), along the axes of Gaussians turned by (N,)."""
    x, y, z = vectors.unbind(-1)
    cos, sin = turns.cos(), turns.sin()
    ahead = x * cos + y * sin
    return torch.stack([ahead, y * cos - x * sin, z.expand_as(ahead)], -1)

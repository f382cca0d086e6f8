"""Who sees which source when rays are missing or mean nothing: rays, neighbours and channels vote together.

A ray that was not measured says little against a source that all neighbours see and that the channel lacks,
and a ray says little for one that the channel knows nothing of. Each receiver's channel, predicted from all
others, is held against itself with one source more or less; the odds before that are those of the neighbours'
sightings and of how often rays are missed or mistaken, which the votes tell in turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

MISTAKEN = 0.003  # share of the pairs without a path that have a ray, at first
LEAST = 1e-3  # of either rate
MOST = 0.2  # share of the paths without a ray, at most, at first
LIKELY = 0.02  # the neighbours are never surer than by this


@dataclass(frozen=True)
class Rates:
    """How far rays are to be trusted.

    Attributes:
        missed: share of the paths that have no ray.
        mistaken: share of the pairs without a path that have one.
    """

    missed: float
    mistaken: float

    @staticmethod
    def first(rays: Tensor) -> Rates:
        """From who has rays (n, K), as if everybody saw the source of most."""
        return Rates(min(max(1 - float(rays.mean(0).max()), LEAST), MOST), MISTAKEN)

    @staticmethod
    def of(rays: Tensor, seen: Tensor) -> Rates:
        """From who has rays and who sees what, both (n, K) of zeros and ones."""
        missed = float((seen * (1 - rays)).sum() / seen.sum().clamp_min(1))
        mistaken = float(((1 - seen) * rays).sum() / (1 - seen).sum().clamp_min(1))
        return Rates(max(missed, LEAST), max(mistaken, LEAST))

    def odds(self, rays: Tensor, likely: Tensor) -> Tensor:
        """Log odds (n, K) that a source is seen, by rays and by how likely it is to the neighbours."""
        likely = (likely / (1 - self.missed)).clamp(LIKELY, 1 - LIKELY)
        told = math.log((1 - self.missed) / self.mistaken)
        untold = math.log(self.missed / (1 - self.mistaken))
        return torch.where(rays > 0, told, untold) + likely.log() - (1 - likely).log()


def flips(seen: Tensor, odds: Tensor, left: Tensor, variance: Tensor, one: Tensor) -> Tensor:
    """(n, K) bool, at most one source of each receiver that is to change.

    Args:
        seen: (n, K) of zeros and ones.
        odds: (n, K), log odds that it is seen, without the channel.
        left: (n, R), channel less its prediction from all others.
        variance: (n,), expected |left|^2.
        one: (n, K, R), what each source adds where it is seen.
    """
    sign = (1 - 2 * seen).to(one.real.dtype)
    after = (left[:, None] - sign[:, :, None] * one).abs().square().sum(2)
    before = left.abs().square().sum(1)[:, None]
    gain = (before - after) / variance[:, None] + sign * odds
    best = gain.argmax(1, keepdim=True)
    return torch.zeros_like(seen, dtype=torch.bool).scatter(1, best, gain.gather(1, best) > 0)

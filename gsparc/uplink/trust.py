"""What a snapshot's own sources say about the error to come: a regression learned on training snapshots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.uplink.atoms import Aperture, Sources

RIDGE = 1e-3
LEAST_ERROR = 1e-6


def signs(found: Sources, left: Tensor, uplink: Tensor, noise: Tensor, tones: Tensor) -> Tensor:
    """Signs of trouble (B, 7): noise, misfit, expected blur at `tones`, cancellation, number and spread.

    Args:
        found: sources of the snapshots.
        left: what they do not explain (B, U, L).
        uplink: (B, U, L).
        noise: (B,).
        tones: (K,) of the downlink, numbers about the uplink's middle.
    """
    power = uplink.abs().square().mean((1, 2)).clamp_min(1e-30)
    strength = found.gain.abs().square()
    total = strength.sum(1).clamp_min(1e-30)
    blurred = 1 - torch.exp(-((2 * math.pi * tones.abs().max()) ** 2) * found.delay_variance)
    blur = (strength * blurred + found.variance).sum(1) / power
    share = strength / total[:, None]
    mean = (share * found.delay).sum(1, keepdim=True)
    columns = [
        noise / power,
        left.abs().square().mean((1, 2)) / noise.clamp_min(1e-30),
        blur,
        total / power,
        1 / share.square().sum(1),
        (share * (found.delay - mean) ** 2).sum(1).sqrt(),
        found.variance.sum(1) / power,
    ]
    return torch.stack([column.clamp_min(1e-9).log10() for column in columns], 1)


@dataclass(frozen=True)
class Trust:
    """Expected logarithm of the relative error as a quadratic form of the signs.

    Attributes:
        middle, scale: (7,) of the signs in training.
        weights: (F,) of the quadratic terms.
        low, high: range of the training errors; nothing beyond is promised.
    """

    middle: Tensor
    scale: Tensor
    weights: Tensor
    low: float
    high: float

    def expected(self, seen: Tensor) -> Tensor:
        """Relative error |e|^2 / |h|^2 to be expected (B,) for signs (B, 7)."""
        logarithm = _quadratic((seen - self.middle) / self.scale) @ self.weights
        return 10 ** logarithm.clamp(self.low, self.high)


def learn(seen: Tensor, relative_error: Tensor) -> Trust:
    """Fit to signs (n, 7) and the relative errors (n,) that came out."""
    middle, scale = seen.mean(0), seen.std(0, correction=0).clamp_min(1e-3)
    terms = _quadratic((seen - middle) / scale).double()
    target = relative_error.clamp_min(LEAST_ERROR).log10().double()
    penalty = RIDGE * len(seen) * torch.eye(terms.shape[1], dtype=torch.float64)
    penalty[0, 0] = 0
    weights = torch.linalg.solve(terms.T @ terms + penalty, terms.T @ target)
    low, high = np.quantile(target.numpy(), [0.001, 0.999])
    return Trust(middle, scale, weights.float(), float(low), float(high))


def _quadratic(x: Tensor) -> Tensor:
    x = x.clamp(-4, 4)
    first, second = torch.triu_indices(x.shape[1], x.shape[1])
    return torch.cat([torch.ones_like(x[:, :1]), x, x[:, first] * x[:, second]], 1)


def unheard_noise(uplink: Tensor, aperture: Aperture, window: tuple[float, float]) -> Tensor:
    """Noise power (B,) from delays at which nothing arrives, for data that do not state theirs."""
    count = len(aperture.tones)
    taper = torch.hann_window(count + 2, periodic=False)[1:-1].to(uplink.real)
    outside = torch.linspace(window[1] + 0.1, window[0] + 0.9, count)
    probe = torch.polar(torch.ones(count, len(outside)), 2 * math.pi * torch.outer(aperture.tones, outside))
    heard = (uplink * taper) @ probe.to(uplink.dtype)
    return heard.abs().square().flatten(1).median(1).values / math.log(2) / taper.square().sum()

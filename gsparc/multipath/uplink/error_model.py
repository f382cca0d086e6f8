"""What a snapshot's own sources say about the error to come: a regression learned on training snapshots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.multipath.uplink.posterior import Sources
from gsparc.physics.plane_waves import Aperture

RIDGE = 1e-3
LEAST_ERROR = 1e-6


@dataclass(frozen=True)
class Heard:
    """Snapshots and what a search made of them.

    Attributes:
        sources: of the snapshots.
        left: what they do not explain (B, U, L).
        uplink: (B, U, L).
        noise: (B,).
    """

    sources: Sources
    left: Tensor
    uplink: Tensor
    noise: Tensor


def signs(heard: Heard, mean: Tensor, aperture: Aperture) -> Tensor:
    """Signs of trouble (B, 10) at an aperture whose channels are predicted to be `mean` (B, A, K).

    Noise, misfit, blur by the posterior and by delays alone (which saturates), cancellation, number and
    spread of the sources, doubt in their gains, how deep a fade the aperture is in, and its size.
    """
    found = heard.sources
    power = heard.uplink.abs().square().mean((1, 2)).clamp_min(1e-30)
    strength = found.gain.abs().square()
    total = strength.sum(1).clamp_min(1e-30)
    turns = 2 * math.pi * aperture.tones.abs().max()
    turned = (strength * (1 - torch.exp(-(turns**2) * found.delay_variance))).sum(1)
    doubt = found.variance.sum(1)
    share = strength / total[:, None]
    middle = (share * found.delay).sum(1, keepdim=True)
    columns = [
        heard.noise / power,
        heard.left.abs().square().mean((1, 2)) / heard.noise.clamp_min(1e-30),
        found.blur(aperture) / power,
        (turned + doubt) / power,
        total / power,
        1 / share.square().sum(1),
        (share * (found.delay - middle) ** 2).sum(1).sqrt(),
        doubt / power,
        mean.abs().square().mean((1, 2)) / power,
        torch.full_like(power, mean[0].numel()),
    ]
    return torch.stack([column.clamp_min(1e-9).log10() for column in columns], 1)


@dataclass(frozen=True)
class Trust:
    """Expected logarithm of the relative error as a quadratic form of the signs.

    Attributes:
        middle, scale: (S,) of the signs in training.
        weights: (F,) of the quadratic terms.
        low, high: range of the training errors; nothing beyond is promised.
        smearing: mean of the errors over that of the exponentials of their expected logarithms (Duan 1983).
    """

    middle: Tensor
    scale: Tensor
    weights: Tensor
    low: float
    high: float
    smearing: float

    def expected(self, seen: Tensor) -> Tensor:
        """Relative error |e|^2 / |h|^2 to be expected (B,) for signs (B, S)."""
        logarithm = _quadratic((seen - self.middle) / self.scale) @ self.weights
        return self.smearing * 10 ** logarithm.clamp(self.low, self.high)


def learn(seen: Tensor, relative_error: Tensor) -> Trust:
    """Fit to signs (n, S) and the relative errors (n,) that came out."""
    middle, scale = seen.mean(0), seen.std(0, correction=0).clamp_min(1e-3)
    terms = _quadratic((seen - middle) / scale).double()
    target = relative_error.clamp_min(LEAST_ERROR).log10().double()
    penalty = RIDGE * len(seen) * torch.eye(terms.shape[1], dtype=torch.float64)
    penalty[0, 0] = 0
    weights = torch.linalg.solve(terms.T @ terms + penalty, terms.T @ target)
    low, high = np.quantile(target.numpy(), [0.001, 0.999])
    expected = 10 ** (terms @ weights).clamp(low, high)
    smearing = relative_error.clamp_max(10**high).double().mean() / expected.mean()
    return Trust(middle, scale, weights.float(), float(low), float(high), float(smearing))


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

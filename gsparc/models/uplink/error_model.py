"""Features of a snapshot's sources that tell the error of a prediction,
and the noise of a snapshot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.models.uplink.interface import mean_power
from gsparc.models.uplink.search import Sources
from gsparc.physics.decibels import TINY_POWER
from gsparc.physics.plane_waves import Aperture

LEAST = 1e-9  # of a feature: a logarithm is taken


@dataclass(frozen=True)
class SearchedSnapshots:
    """Snapshots and the sources found in them.

    Attributes:
        sources: of the snapshots.
        residual: residual (B, U, L).
        uplink: (B, U, L).
        noise: (B,).
    """

    sources: Sources
    residual: Tensor
    uplink: Tensor
    noise: Tensor

    def features(self, mean: Tensor, aperture: Aperture) -> Tensor:
        """Return features (B, 10) of the error at an aperture
        with predicted channels `mean` (B, A, K).

        Noise, misfit, posterior variance, variance by delays alone (which saturates), cancellation,
        number and delay spread of the sources, variance of their gains,
        fading depth at the aperture, and its size.
        """
        sources = self.sources
        heard, strength = mean_power(self.uplink), sources.gain.abs().square()
        total = strength.sum(1).clamp_min(TINY_POWER)
        turns = 2 * math.pi * aperture.tones.abs().max()
        # An unknown phase costs no more than the source's power, which a first order does not know.
        delay_error = (strength * (1 - torch.exp(-(turns**2) * sources.delay_variance))).sum(1)
        gain_variance = sources.variance.sum(1)
        share = strength / total[:, None]
        middle = (share * sources.delay).sum(1, keepdim=True)
        columns = [
            self.noise / heard,
            mean_power(self.residual) / self.noise.clamp_min(TINY_POWER),
            sources.error_variance(aperture) / heard,
            (delay_error + gain_variance) / heard,
            total / heard,
            1 / share.square().sum(1),
            (share * (sources.delay - middle) ** 2).sum(1).sqrt(),
            gain_variance / heard,
            mean_power(mean) / heard,
            torch.full_like(heard, mean[0].numel()),
        ]
        return torch.stack([column.clamp_min(LEAST).log10() for column in columns], 1)


def estimate_noise(uplink: Tensor, aperture: Aperture, window: tuple[float, float]) -> Tensor:
    """Return the noise power (B,) from delays without paths, for data that do not state theirs."""
    count = len(aperture.tones)
    # Without a taper side lobes of strong paths would be taken for noise.
    taper = torch.hann_window(count + 2, periodic=False)[1:-1].to(uplink.real)
    # Delays repeat after 1 turn per tone: the part of the period outside the window,
    # .1 from its ends.
    outside = torch.linspace(window[1] + 0.1, window[0] + 0.9, count)
    probe = torch.polar(
        torch.ones(count, len(outside)), 2 * math.pi * torch.outer(aperture.tones, outside)
    )
    result = (uplink * taper) @ probe.to(uplink.dtype)
    # The median of an exponential power is log 2 of its mean, and is moved little by paths.
    return result.abs().square().flatten(1).median(1).values / math.log(2) / taper.square().sum()

"""Error model: expected relative error of a prediction, regressed on features of the snapshot's sources."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.models.uplink.interface import power
from gsparc.models.uplink.search import Sources
from gsparc.physics.plane_waves import Aperture

RIDGE = 1e-3  # of the mean square of a standardised feature
LEAST_ERROR = 1e-6  # -60 dB: logarithms of smaller ones would decide the fit


@dataclass(frozen=True)
class SearchResult:
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
        """Return features (B, 10) of the error at an aperture with predicted channels `mean` (B, A, K).

        Noise, misfit, posterior variance, variance by delays alone (which saturates), cancellation, number
        and delay spread of the sources, variance of their gains, fading depth at the aperture, and its size.
        """
        sources = self.sources
        heard, strength = power(self.uplink), sources.gain.abs().square()
        total = strength.sum(1).clamp_min(1e-30)
        turns = 2 * math.pi * aperture.tones.abs().max()
        # An unknown phase costs no more than the source's power, which a first order does not know.
        delay_error = (strength * (1 - torch.exp(-(turns**2) * sources.delay_variance))).sum(1)
        gain_variance = sources.variance.sum(1)
        share = strength / total[:, None]
        middle = (share * sources.delay).sum(1, keepdim=True)
        columns = [
            self.noise / heard,
            power(self.residual) / self.noise.clamp_min(1e-30),
            sources.error_variance(aperture) / heard,
            (delay_error + gain_variance) / heard,
            total / heard,
            1 / share.square().sum(1),
            (share * (sources.delay - middle) ** 2).sum(1).sqrt(),
            gain_variance / heard,
            power(mean) / heard,
            torch.full_like(heard, mean[0].numel()),
        ]
        return torch.stack([column.clamp_min(1e-9).log10() for column in columns], 1)


@dataclass(frozen=True)
class RelativeErrorRegression:
    """Expected logarithm of the relative error as a quadratic form of the features.

    Attributes:
        middle, scale: (S,) of the features in training.
        weights: (F,) of the quadratic terms.
        low, high: range of the training errors, to which predictions are clipped.
        smearing: mean of the errors over that of the exponentials of their expected logarithms (Duan 1983).
    """

    middle: Tensor
    scale: Tensor
    weights: Tensor
    low: float
    high: float
    smearing: float

    def expected(self, features: Tensor) -> Tensor:
        """Return the expected relative error |e|^2 / |h|^2 (B,) for features (B, S)."""
        logarithm = _quadratic((features - self.middle) / self.scale) @ self.weights
        return self.smearing * 10 ** logarithm.clamp(self.low, self.high)

    @classmethod
    def of(cls, features: Tensor, relative_error: Tensor) -> RelativeErrorRegression:
        """Fit to features (n, S) and relative errors (n,)."""
        middle, scale = features.mean(0), features.std(0, correction=0).clamp_min(1e-3)
        terms = _quadratic((features - middle) / scale).double()
        target = relative_error.clamp_min(LEAST_ERROR).log10().double()
        penalty = RIDGE * len(features) * torch.eye(terms.shape[1], dtype=torch.float64)
        # The mean error is not shrunk.
        penalty[0, 0] = 0
        weights = torch.linalg.solve(terms.T @ terms + penalty, terms.T @ target)
        # A quadratic form goes anywhere beyond its data: answers stay within what training saw.
        low, high = np.quantile(target.numpy(), [0.001, 0.999])
        expected = 10 ** (terms @ weights).clamp(low, high)
        smearing = relative_error.clamp_max(10**high).double().mean() / expected.mean()
        return cls(middle, scale, weights.float(), float(low), float(high), float(smearing))


def _quadratic(x: Tensor) -> Tensor:
    # Four deviations from all training snapshots a square says nothing any more.
    x = x.clamp(-4, 4)
    first, second = torch.triu_indices(x.shape[1], x.shape[1])
    return torch.cat([torch.ones_like(x[:, :1]), x, x[:, first] * x[:, second]], 1)


def estimate_noise(uplink: Tensor, aperture: Aperture, window: tuple[float, float]) -> Tensor:
    """Return the noise power (B,) from delays without paths, for data that do not state theirs."""
    count = len(aperture.tones)
    # Without a taper side lobes of strong paths would be taken for noise.
    taper = torch.hann_window(count + 2, periodic=False)[1:-1].to(uplink.real)
    # Delays repeat after 1 turn per tone: the part of the period outside the window, .1 from its ends.
    outside = torch.linspace(window[1] + 0.1, window[0] + 0.9, count)
    probe = torch.polar(torch.ones(count, len(outside)), 2 * math.pi * torch.outer(aperture.tones, outside))
    result = (uplink * taper) @ probe.to(uplink.dtype)
    # The median of an exponential power is log 2 of its mean, and is moved little by paths.
    return result.abs().square().flatten(1).median(1).values / math.log(2) / taper.square().sum()

"""Visibility of sources, known at receivers by their directions of arrival and predicted elsewhere.

Rays may be missing or spurious: each receiver's leave-one-out residual of the channels is compared
with one source more or less. The prior odds that it sees a source come from its own ray, the rates
of missed and spurious rays, and the leave-one-out visibility of its neighbours; the rates are
estimated anew from the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gsparc.processes.kernel import distances
from gsparc.processes.left_out import left_out_residuals as residuals
from gsparc.processes.matern import matern32_of_squares

LENGTHS_M = tuple(0.05 * 2.0 ** np.arange(7))  # candidates for every source
NOISES = (0.03, 0.1, 0.3, 1.0)  # candidates, in units of the process's variance
SPURIOUS = 0.003  # initial share of the pairs without a path that have a ray
MIN_RATE = 1e-3  # lower bound of either rate
MAX_MISSED = 0.2  # upper bound of the initial share of paths without a ray
MIN_PROBABILITY = 0.02  # bound of the neighbours' probabilities


@dataclass(frozen=True)
class VisibilityGP:
    """One Gaussian process over places per source, on labels 0 and 1.

    Least-squares classification (Rasmussen and Williams 2006, section 6.5); length and noise
    minimise the leave-one-out error.

    Attributes:
        places: (n, 3) float64 [m], receivers.
        seen: (n, K) float64, 1 where a ray of the receiver points at the source.
        length: (K,) [m].
        weights: (n, K), of the deviations from the mean.
        left_out: (n, K) in [0, 1], leave-one-out predictions.
    """

    places: Tensor
    seen: Tensor
    length: Tensor
    weights: Tensor
    left_out: Tensor

    @staticmethod
    def from_visibility(places: Tensor, seen: Tensor) -> VisibilityGP:
        """Learn from the visibility of K sources at n receivers."""
        distance, mean = torch.cdist(places, places), seen.mean(0)
        length, weights = torch.full_like(mean, LENGTHS_M[-1]), torch.zeros_like(seen)
        left_out = mean.expand_as(seen).clone()  # without a better kernel the mean
        best = (left_out - seen).square().mean(0)
        for length_m in LENGTHS_M:
            values, vectors = torch.linalg.eigh(matern32_of_squares((distance / length_m).square()))
            turned = vectors.T @ (seen - mean)
            for noise in NOISES:
                shrunk = 1 / (values.clamp_min(0) + noise)
                alpha = vectors @ (shrunk[:, None] * turned)
                inverse = (vectors.square() * shrunk).sum(1)
                predicted = (seen - residuals(inverse, alpha)[0]).clamp(0, 1)
                error = (predicted - seen).square().mean(0)
                better = error < best
                best = torch.where(better, error, best)
                length[better], weights[:, better] = length_m, alpha[:, better]
                left_out[:, better] = predicted[:, better]
        return VisibilityGP(places, seen, length, weights, left_out)

    def probability_seen(self, places: Tensor) -> Tensor:
        """Return the probability (m, K) float64 that each source is seen from places (m, 3) [m]."""
        lengths, weights = self._lengths_and_weights
        correlation = matern32_of_squares(
            (distances(places, self.places)[:, None] / lengths).square()
        ).flatten(1)
        return torch.addmm(self._mean, correlation, weights).clamp(0, 1)

    @cached_property
    def _mean(self) -> Tensor:
        return self.seen.mean(0)

    @cached_property
    def _lengths_and_weights(self) -> tuple[Tensor, Tensor]:
        """Lengths (L, 1) [m] that occur, and the weights (L n, K),
        zero but for those of a source's own.
        """
        lengths = self.length.unique()[:, None]
        return lengths, torch.where(lengths[:, None] == self.length, self.weights, 0.0).flatten(
            0, 1
        )


@dataclass(frozen=True)
class RayErrorRates:
    """Error rates of measured rays.

    Attributes:
        missed: share of the paths that have no ray.
        spurious: share of the pairs without a path that have one.
    """

    missed: float
    spurious: float

    @staticmethod
    def from_rays(rays: Tensor) -> RayErrorRates:
        """Return initial rates from rays (n, K),
        as if all receivers saw the source with most rays.
        """
        return RayErrorRates(
            min(max(1 - float(rays.mean(0).max()), MIN_RATE), MAX_MISSED), SPURIOUS
        )

    @staticmethod
    def from_visibility(rays: Tensor, seen: Tensor) -> RayErrorRates:
        """Estimate from rays and visibility, both (n, K) of zeros and ones."""
        missed = float((seen * (1 - rays)).sum() / seen.sum().clamp_min(1))
        spurious = float(((1 - seen) * rays).sum() / (1 - seen).sum().clamp_min(1))
        return RayErrorRates(
            *(min(max(rate, MIN_RATE), 1 - MIN_RATE) for rate in (missed, spurious))
        )

    def log_odds_seen(self, rays: Tensor, probability: Tensor) -> Tensor:
        """Log odds (n, K) that a source is seen, by rays and the neighbours' probability (n, K)."""
        probability = (probability / (1 - self.missed)).clamp(MIN_PROBABILITY, 1 - MIN_PROBABILITY)
        detected = math.log((1 - self.missed) / self.spurious)
        undetected = math.log(self.missed / (1 - self.spurious))
        return (
            torch.where(rays > 0, detected, undetected)
            + probability.log()
            - (1 - probability).log()
        )


def entries_to_flip(
    seen: Tensor, odds: Tensor, residual: Tensor, variance: Tensor, contribution: Tensor
) -> Tensor:
    """Return (n, K) bool, at most one visibility entry to change per receiver.

    Args:
        seen: (n, K) of zeros and ones.
        odds: (n, K), prior log odds that it is seen.
        residual: (n, R), leave-one-out residual of the channels.
        variance: (n,), expected |left|^2.
        contribution: (n, K, R), what each source adds where it is seen.
    """
    sign = (1 - 2 * seen).to(contribution.real.dtype)
    after = (residual[:, None] - sign[:, :, None] * contribution).abs().square().sum(2)
    before = residual.abs().square().sum(1)[:, None]
    gain = (before - after) / variance[:, None] + sign * odds
    best = gain.argmax(1, keepdim=True)
    return torch.zeros_like(seen, dtype=torch.bool).scatter(1, best, gain.gather(1, best) > 0)

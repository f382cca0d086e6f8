"""A Gaussian vector of which some entries are known and others only to lie below or above a level.

Expectation propagation: each factor "beyond the level" is replaced by a Gaussian that gives the same mean
and variance together with all others (T. Minka, "Expectation propagation for approximate Bayesian inference",
UAI 2001; Rasmussen and Williams 2006, section 3.6; for truncated Gaussians J. P. Cunningham et al., "Gaussian
probabilities and expectation propagation", 2011). Noise belongs to the vector's covariance, so the factors
are steps; with the noise in the factor, Phi((level - f) / sigma), the fixed point is the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.processes.factor import Factor

FAR = -30.0  # standard deviations below which the ratio of density and distribution is a series
LEAST = 1e-6  # share of its variance that a factor takes away at least: none at all has no pseudo-value
DAMPING = 0.8
MOST_SWEEPS = 50
SETTLED = 1e-3  # standard deviations that no mean moves by any more
CERTAIN = 4.0  # standard deviations below its level: being told so changes nothing


@dataclass(frozen=True)
class Sites:
    """Gaussian stand-ins of the factors of m censored rows.

    Attributes:
        value: (m,) pseudo-measured values.
        variance: (m,) their variances, beyond the noise.
        log_evidence: logarithm of the probability of everything that was given.
        settled: whether the sweeps came to rest.
    """

    value: Tensor
    variance: Tensor
    log_evidence: float
    settled: bool


def truncated(z: Tensor) -> tuple[Tensor, Tensor]:
    """Of a standard normal cut off above z (n,): minus its mean, and the share of its variance lost."""
    inside, t = z.clamp_min(FAR), 1 / z.clamp_max(FAR)
    ratio = (-inside.square() / 2 - 0.5 * math.log(2 * math.pi) - torch.special.log_ndtr(inside)).exp()
    series = -1 / t - t + 2 * t**3  # Abramowitz and Stegun 26.2.12
    remaining = t**2 * (1 - 6 * t**2 + 50 * t**4)
    lost = torch.where(z < FAR, 1 - remaining, ratio * (inside + ratio))
    return torch.where(z < FAR, series, ratio), lost.clamp(LEAST, 1 - 1e-12)


def propagate(
    known: ConditionalGaussian, level: Tensor, side: Tensor | float = 1.0, start: Sites | None = None
) -> Sites:
    """Stand-ins for "below `level`" (m,), or "above" where `side` is -1, of a vector's unknown entries.

    Sweeps begin at those of a similar vector where `start` has them: the fixed point is the same.
    """
    mean, covariance = known.mean, known.covariance
    total = covariance.diagonal()
    value, variance = (start.value, start.variance) if start else _sites(mean, total, level, side)
    settled, before = False, mean
    for _ in range(MOST_SWEEPS):
        factor = Factor.of(covariance + torch.diag(variance), "raise")
        precision = factor.precision
        weights = factor.solved((value - mean)[:, None])[:, 0]
        cavity_variance = (1 / precision - variance).clamp(LEAST * total, total)
        cavity = value - weights / precision
        result, wide = _sites(cavity, cavity_variance, level, side)
        settled = bool(((cavity - before).abs() / total.sqrt()).max() < SETTLED)
        if settled:
            break
        before = cavity
        both = (1 - DAMPING) / variance + DAMPING / wide
        value = ((1 - DAMPING) * value / variance + DAMPING * result / wide) / both
        variance = 1 / both
    apart = cavity_variance + variance
    evidence = -0.5 * (((value - mean) @ weights) + factor.log_determinant)
    evidence += torch.special.log_ndtr(side * (level - cavity) / cavity_variance.sqrt()).sum()
    evidence += 0.5 * (apart.log() + (cavity - value).square() / apart).sum()
    return Sites(value, variance, float(evidence), settled)


def _sites(mean: Tensor, variance: Tensor, level: Tensor, side: Tensor | float) -> tuple[Tensor, Tensor]:
    """Values and variances (m,) that turn Gaussians (m,) into ones with the moments of the parts allowed."""
    deviation = variance.sqrt()
    ratio, lost = truncated(side * (level - mean) / deviation)
    return mean - side * deviation * ratio / lost, variance * (1 - lost) / lost


@dataclass(frozen=True)
class ConditionalGaussian:
    """Unknown entries given the known ones.

    Attributes:
        mean: (m,), and covariance (m, m).
        log_evidence: logarithm of the density of the known ones.
    """

    mean: Tensor
    covariance: Tensor
    log_evidence: float

    @classmethod
    def of(cls, gram: Tensor, values: Tensor, unknown: Tensor) -> ConditionalGaussian:
        """Of a vector of mean zero.

        Args:
            gram: (n, n) covariance with noise.
            values: (n,), read where known.
            unknown: (n,) bool.
        """
        known = ~unknown
        factor = Factor.of(gram[known][:, known], "raise")
        white = factor.whitened(torch.cat([gram[known][:, unknown], values[known][:, None]], 1))
        cross, white = white[:, :-1], white[:, -1]
        evidence = -0.5 * (white @ white + factor.log_determinant + len(white) * math.log(2 * math.pi))
        return cls(cross.T @ white, gram[unknown][:, unknown] - cross.T @ cross, float(evidence))

    def doubt(self, level: Tensor) -> Tensor:
        """Deviations (m,) that entries lie below `level` (m,) by: beyond `CERTAIN` nothing is told."""
        return (level - self.mean) / self.covariance.diagonal().sqrt()

    def at(self, rows: Tensor) -> ConditionalGaussian:
        """The entries `rows` alone."""
        return ConditionalGaussian(self.mean[rows], self.covariance[rows][:, rows], self.log_evidence)


def log_evidence(
    gram: Tensor, values: Tensor, side: Tensor, last: list[Sites] | None = None
) -> tuple[float, Tensor, Tensor]:
    """Logarithm of the probability of known values and of the rest beyond their levels.

    Returns:
        It, its slopes by `gram`, and minus its slopes by values and levels.

    At the fixed point the stand-ins' own change has no effect (Rasmussen and Williams 2006, section 5.5.2).

    Args:
        gram: (n, n) covariance with noise.
        values: (n,) known values, or levels.
        side: (n,) 0 where known, 1 below the level, -1 above it.
        last: stand-ins that were found for similar covariances, the first to begin with; those found now
            take its place.
    """
    unknown = side != 0
    if not unknown.any():
        factor = Factor.of(gram, "raise")
        weights = factor.solved(values[:, None])[:, 0]
        value = -0.5 * (values @ weights + factor.log_determinant + len(values) * math.log(2 * math.pi))
        return float(value), 0.5 * (torch.outer(weights, weights) - factor.inverse), weights
    known = ConditionalGaussian.of(gram, values, unknown)
    sites = propagate(known, values[unknown], side[unknown], last[0] if last else None)
    if last is not None:
        last[:] = [sites]
    extra = torch.zeros_like(values).masked_scatter(unknown, sites.variance)
    inverse = Factor.of(gram + torch.diag(extra), "raise").inverse
    weights = inverse @ values.masked_scatter(unknown, sites.value)
    return known.log_evidence + sites.log_evidence, 0.5 * (torch.outer(weights, weights) - inverse), weights

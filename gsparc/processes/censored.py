"""A Gaussian vector of which some entries are known and others only to lie below or above a level.

Expectation propagation: each factor "beyond the level" is replaced by a Gaussian that gives the
same mean and variance together with all others (T. Minka, "Expectation propagation for approximate
Bayesian inference", UAI 2001; Rasmussen and Williams 2006, section 3.6; for truncated Gaussians J.
P. Cunningham et al., "Gaussian probabilities and expectation propagation", 2011). Noise belongs to
the vector's covariance, so the factors are steps; with the noise in the factor, Phi((level - f) /
sigma), the fixed point is the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsparc.processes.averages import MeanVariance
from gsparc.processes.factor import Factor

FAR = -30.0  # standard deviations below which the ratio of density and distribution is a series
# Share of its variance that a factor takes away at least: none at all has no pseudo-value
LEAST = 1e-6
DAMPING = 0.8
MOST_SWEEPS = 50
# Standard deviations that no mean moves by any more; at looks of a search
SETTLED, NEARLY = 1e-3, 1e-2
CERTAIN = 4.0  # standard deviations below its level: being told so changes nothing


@dataclass(frozen=True)
class PseudoValues:
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


class TruncatedMoments(NamedTuple):
    """Of a standard normal cut off above a level: minus its mean,
    and the share of its variance lost.
    """

    minus_mean: Tensor
    lost_variance: Tensor


def truncated_moments(z: Tensor) -> TruncatedMoments:
    """Return moments (n,) of a standard normal cut off above z (n,).

    >>> truncated_moments(torch.tensor([0.0]))  # sqrt(2 / pi), and 2 / pi
    TruncatedMoments(minus_mean=tensor([0.7979]), lost_variance=tensor([0.6366]))
    """
    inside, t = z.clamp_min(FAR), 1 / z.clamp_max(FAR)
    # In logarithms: density and distribution underflow long before their ratio does.
    ratio = (
        -inside.square() / 2 - 0.5 * math.log(2 * math.pi) - torch.special.log_ndtr(inside)
    ).exp()
    series = -1 / t - t + 2 * t**3  # Abramowitz and Stegun 26.2.12
    remaining = t**2 * (1 - 6 * t**2 + 50 * t**4)
    reduction = torch.where(z < FAR, 1 - remaining, ratio * (inside + ratio))
    return TruncatedMoments(torch.where(z < FAR, series, ratio), reduction.clamp(LEAST, 1 - 1e-12))


def fit_by_ep(
    prior: ConditionalGaussian,
    level: Tensor,
    side: Tensor | float = 1.0,
    start: PseudoValues | None = None,
    tolerance: float = SETTLED,
) -> PseudoValues:
    """Find stand-ins for "below `level`" (m,), "above" where `side` is -1, of unknown entries.

    Sweeps begin at those of a similar vector where `start` has them: the fixed point is the same.
    They end when no mean moves by more than `tolerance` deviations.
    """
    mean, covariance = prior.mean, prior.covariance
    total = covariance.diagonal()
    value, variance = (
        (start.value, start.variance) if start else _match_sites(mean, total, level, side)
    )
    settled, before = False, mean
    for _ in range(MOST_SWEEPS):
        factor = Factor.from_gram(covariance + torch.diag(variance), "raise")
        precision = factor.precision
        weights = factor.solve((value - mean)[:, None])[:, 0]
        # The cavity: what all others say of an entry, its own stand-in taken out.
        cavity_variance = (1 / precision - variance).clamp(LEAST * total, total)
        cavity = value - weights / precision
        result, wide = _match_sites(cavity, cavity_variance, level, side)
        settled = bool(((cavity - before).abs() / total.sqrt()).max() < tolerance)
        if settled:
            break
        before = cavity
        # Damped in precision and precision times mean, which add where Gaussians multiply.
        both = (1 - DAMPING) / variance + DAMPING / wide
        value = ((1 - DAMPING) * value / variance + DAMPING * result / wide) / both
        variance = 1 / both
    # The evidence of expectation propagation: Rasmussen and Williams 2006, eq. 3.65.
    variance_sum = cavity_variance + variance
    evidence = -0.5 * (((value - mean) @ weights) + factor.log_determinant)
    evidence += torch.special.log_ndtr(side * (level - cavity) / cavity_variance.sqrt()).sum()
    evidence += 0.5 * (variance_sum.log() + (cavity - value).square() / variance_sum).sum()
    return PseudoValues(value, variance, float(evidence), settled)


def _match_sites(
    mean: Tensor, variance: Tensor, level: Tensor, side: Tensor | float
) -> MeanVariance:
    """Values and variances (m,) that turn Gaussians (m,)
    into ones with the moments of the parts allowed.
    """
    deviation = variance.sqrt()
    ratio, reduction = truncated_moments(side * (level - mean) / deviation)
    return MeanVariance(
        mean - side * deviation * ratio / reduction, variance * (1 - reduction) / reduction
    )


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
    def from_gram(cls, gram: Tensor, values: Tensor, unknown: Tensor) -> ConditionalGaussian:
        """Condition a vector of mean zero on its known entries.

        Args:
            gram: (n, n) covariance with noise.
            values: (n,), read where known.
            unknown: (n,) bool.
        """
        is_known = ~unknown
        factor = Factor.from_gram(gram[is_known][:, is_known], "raise")
        # Cross covariances and values in one solve.
        white = factor.whiten(torch.cat([gram[is_known][:, unknown], values[is_known][:, None]], 1))
        cross, white = white[:, :-1], white[:, -1]
        evidence = -0.5 * (
            white @ white + factor.log_determinant + len(white) * math.log(2 * math.pi)
        )
        return cls(cross.T @ white, gram[unknown][:, unknown] - cross.T @ cross, float(evidence))

    def z_score(self, level: Tensor) -> Tensor:
        """Return deviations (m,) that entries lie below `level` (m,) by:
        beyond `CERTAIN` nothing is told.
        """
        return (level - self.mean) / self.covariance.diagonal().sqrt()

    def marginal(self, rows: Tensor) -> ConditionalGaussian:
        """Return the entries `rows` alone."""
        return ConditionalGaussian(
            self.mean[rows], self.covariance[rows][:, rows], self.log_evidence
        )


def log_evidence(
    gram: Tensor, values: Tensor, side: Tensor, last: list[PseudoValues] | None = None
) -> tuple[float, Tensor, Tensor]:
    """Return the logarithm of the probability of known values and of the rest beyond their levels.

    >>> gram, level = torch.eye(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    >>> round(math.exp(log_evidence(gram, level, torch.ones(2))[0]), 3)  # both below their mean
    0.25

    Returns:
        It, its slopes by `gram`, and minus its slopes by values and levels.

    At the fixed point the stand-ins' own change has no effect (Rasmussen
    and Williams 2006, section 5.5.2).

    Args:
        gram: (n, n) covariance with noise.
        values: (n,) known values, or levels.
        side: (n,) 0 where known, 1 below the level, -1 above it.
        last: stand-ins that were found for similar covariances, the first to begin with; those
            found now take its place.
    """
    unknown = side != 0
    if not unknown.any():
        factor = Factor.from_gram(gram, "raise")
        weights = factor.solve(values[:, None])[:, 0]
        value = -0.5 * (
            values @ weights + factor.log_determinant + len(values) * math.log(2 * math.pi)
        )
        return float(value), 0.5 * (torch.outer(weights, weights) - factor.inverse), weights
    prior = ConditionalGaussian.from_gram(gram, values, unknown)
    begin, within = (last[0] if last else None), SETTLED if last is None else NEARLY
    sites = fit_by_ep(prior, values[unknown], side[unknown], begin, within)
    if last is not None:
        last[:] = [sites]
    # A stand-in is a measurement whose noise is its own variance.
    extra = torch.zeros_like(values).masked_scatter(unknown, sites.variance)
    inverse = Factor.from_gram(gram + torch.diag(extra), "raise").inverse
    weights = inverse @ values.masked_scatter(unknown, sites.value)
    return (
        prior.log_evidence + sites.log_evidence,
        0.5 * (torch.outer(weights, weights) - inverse),
        weights,
    )

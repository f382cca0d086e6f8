"""A Gaussian vector of which some entries are known and others only to lie below a level.

Expectation propagation: each factor "below the level" is replaced by a Gaussian that gives the same mean
and variance together with all others (T. Minka, "Expectation propagation for approximate Bayesian inference",
UAI 2001; Rasmussen and Williams 2006, section 3.6; for truncated Gaussians J. P. Cunningham et al., "Gaussian
probabilities and expectation propagation", 2011). Noise belongs to the vector's covariance, so the factors
are steps; with the noise in the factor, Phi((level - f) / sigma), the fixed point is the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr

from gsparc.methods.power_kernel import inverse_of

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

    value: np.ndarray
    variance: np.ndarray
    log_evidence: float
    settled: bool


def truncated(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a standard normal cut off above z (n,): minus its mean, and the share of its variance lost."""
    inside = np.maximum(z, FAR)
    ratio = np.exp(-(inside**2) / 2 - 0.5 * math.log(2 * math.pi) - log_ndtr(inside))
    t = 1 / np.minimum(z, FAR)
    series = -1 / t - t + 2 * t**3  # Abramowitz and Stegun 26.2.12
    kept = t**2 * (1 - 6 * t**2 + 50 * t**4)
    lost = np.where(z < FAR, 1 - kept, ratio * (inside + ratio))
    return np.where(z < FAR, series, ratio), np.clip(lost, LEAST, 1 - 1e-12)


def propagate(told: Told, level: np.ndarray) -> Sites:
    """Stand-ins for "below `level`" (m,) of the unknown entries of a Gaussian vector."""
    mean, covariance = told.mean, told.covariance
    total = covariance.diagonal()
    value, variance = _sites(mean, total, level)
    settled, before = False, mean
    for _ in range(MOST_SWEEPS):
        gram = covariance.copy()
        gram[np.diag_indices_from(gram)] += variance
        inverse, logdet = inverse_of(gram)
        weights, share = inverse @ (value - mean), inverse.diagonal()
        cavity_variance = np.clip(1 / share - variance, LEAST * total, total)
        cavity = value - weights / share
        found, wide = _sites(cavity, cavity_variance, level)
        settled = bool(np.max(np.abs(cavity - before) / np.sqrt(total)) < SETTLED)
        if settled:
            break
        before = cavity
        precision = (1 - DAMPING) / variance + DAMPING / wide
        value = ((1 - DAMPING) * value / variance + DAMPING * found / wide) / precision
        variance = 1 / precision
    apart = cavity_variance + variance
    evidence = -0.5 * (float((value - mean) @ weights) + logdet)
    evidence += float(log_ndtr((level - cavity) / np.sqrt(cavity_variance)).sum())
    evidence += 0.5 * float((np.log(apart) + (cavity - value) ** 2 / apart).sum())
    return Sites(value, variance, evidence, settled)


def _sites(mean: np.ndarray, variance: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and variances (m,) that turn Gaussians (m,) into ones with the moments of their lower parts."""
    deviation = np.sqrt(variance)
    z = (level - mean) / deviation
    ratio, lost = truncated(z)
    return mean - deviation * ratio / lost, variance * (1 - lost) / lost


@dataclass(frozen=True)
class Told:
    """What known entries say of the others.

    Attributes:
        mean: (m,), and covariance (m, m), of the unknown entries given the known ones.
        log_evidence: logarithm of the density of the known ones.
    """

    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float

    def uncertain(self, level: np.ndarray) -> np.ndarray:
        """Entries (m,) bool that the known ones leave in doubt to lie below `level` (m,)."""
        return level - self.mean < CERTAIN * np.sqrt(self.covariance.diagonal())

    def of(self, kept: np.ndarray) -> Told:
        """The entries `kept` alone."""
        return Told(self.mean[kept], self.covariance[np.ix_(kept, kept)], self.log_evidence)


def condition(gram: np.ndarray, values: np.ndarray, unknown: np.ndarray) -> Told:
    """Gaussian conditioning of a vector of mean zero.

    Args:
        gram: (n, n) covariance with noise.
        values: (n,), read where known.
        unknown: (n,) bool.
    """
    known = ~unknown
    lower = cholesky(gram[np.ix_(known, known)], lower=True, check_finite=False)
    cross = solve_triangular(lower, gram[np.ix_(known, unknown)], lower=True, check_finite=False)
    white = solve_triangular(lower, values[known], lower=True, check_finite=False)
    logdet = 2 * float(np.log(lower.diagonal()).sum())
    evidence = -0.5 * (float(white @ white) + logdet + len(white) * math.log(2 * math.pi))
    return Told(cross.T @ white, gram[np.ix_(unknown, unknown)] - cross.T @ cross, evidence)


def log_evidence(gram: np.ndarray, values: np.ndarray, unknown: np.ndarray) -> tuple[float, np.ndarray]:
    """Logarithm of the probability of known values and of the rest below their levels; slopes by `gram`.

    At the fixed point the stand-ins' own change has no effect (Rasmussen and Williams 2006, section 5.5.2).

    Args:
        gram: (n, n) covariance with noise.
        values: (n,) known values, levels where `unknown`.
        unknown: (n,) bool.
    """
    told = condition(gram, values, unknown)
    sites = propagate(told, values[unknown])
    whole = gram.copy()
    rows = np.flatnonzero(unknown)
    whole[rows, rows] += sites.variance
    pseudo = values.copy()
    pseudo[unknown] = sites.value
    inverse, _ = inverse_of(whole)
    weights = inverse @ pseudo
    return told.log_evidence + sites.log_evidence, 0.5 * (np.outer(weights, weights) - inverse)

"""Levels as a field over places: correlated exponentially, noise, and a mean that is linear in regressors.

Correlation is Gudmundson's (Electronics Letters 27, 1991). Its length, and how strong the noise is beside it,
are those of most likelihood on a grid: for questions about data, which finer ones answer no better.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.distance import cdist

from gsparc.processes.factor import Factor

REACHES = (1 / 3, 1 / 10, 1 / 30, 1 / 100)  # lengths of correlation, parts of the region
NUGGETS = (0.05, 0.2, 0.7, 3.0)  # variance of fading and noise, parts of that of shadowing
SPREADS = (0.1, 1.0, 10.0, 100.0)  # variance of the groups' constants, parts of that of shadowing


@dataclass(frozen=True)
class LevelField:
    """The likeliest settings, and the regressors.

    Attributes:
        score: logarithm of the likelihood, less half of that of the rows for each slope.
        length: of correlation [m].
        nugget: variance of noise, part of that of the correlated field.
        variance: of the correlated field [dB^2].
        columns: (n, k) regressors.
        slope: (k,) of them.
    """

    score: float
    length: float
    nugget: float
    variance: float
    columns: np.ndarray
    slope: np.ndarray

    @property
    def regression(self) -> np.ndarray:
        """What the regressors add (n,)."""
        return self.columns @ self.slope

    def precision(self, place: np.ndarray) -> np.ndarray:
        """Return the inverse covariance (m, m) [1/dB^2] of levels at places (m, d) [m]."""
        return _factor(cdist(place, place), self.length, self.nugget).inverse.numpy() / self.variance


def fit_level_field(
    place: np.ndarray, level: np.ndarray, group: np.ndarray, columns: Sequence[np.ndarray] = (),
    nuggets: Sequence[float] = NUGGETS,
) -> LevelField:  # fmt: skip
    """Fit a field and a constant for each of groups, and slopes of columns over all of them.

    Constants are random about a mean that nobody knows (restricted likelihood): many groups of few rows cost
    what they leave open, not half a logarithm of all rows each.

    >>> place = np.random.default_rng(0).uniform(0, 100, (60, 2))
    >>> field = fit_level_field(place, 3 * place[:, 0], np.zeros(60), [place[:, 0]])
    >>> field.slope.round(3)
    array([3.])

    Args:
        place: (n, d) [m].
        level: (n,) [dB].
        group: (n,) labels; fields of different ones have nothing but settings in common.
        columns: regressors (n,).
        nuggets: that are tried.
    """
    count, wide = len(level), float(np.ptp(place, axis=0).max())
    table = np.column_stack([level, *columns])
    parts = [np.flatnonzero(group == one) for one in np.unique(group)]
    apart = [cdist(place[part], place[part]) for part in parts]
    found = []
    for length in (max(reach * wide, 1e-9) for reach in REACHES):
        for nugget in nuggets:
            gram, logarithms, means = np.zeros((table.shape[1],) * 2), 0.0, []
            for part, distance in zip(parts, apart, strict=True):
                factor = _factor(distance, length, nugget)
                both = np.column_stack([np.ones(len(part)), table[part]])
                white = factor.whiten(torch.from_numpy(both)).numpy()
                known = float(white[:, 0] @ white[:, 0])
                mean = white[:, 0] @ white[:, 1:] / known
                own = white[:, 1:] - np.outer(white[:, 0], mean)
                gram += own.T @ own
                logarithms += 2 * float(factor.lower.diagonal().log().sum())
                means.append((known, *mean))
            slope = np.linalg.pinv(gram[1:, 1:]) @ gram[1:, 0]
            rest = float(gram[0, 0] - slope @ gram[1:, 0])
            weight, constant = np.array(means)[:, 0], np.array(means)[:, 1:] @ np.r_[1.0, -slope]
            for spread in SPREADS:
                own = 1 / (spread + 1 / weight)
                between = float(own @ (constant - own @ constant / own.sum()) ** 2)
                variance = max((rest + between) / count, 1e-6)
                more = float(np.log1p(spread * weight).sum()) + math.log(own.sum())
                more += len(slope) * math.log(count)
                score = -0.5 * (count * math.log(variance) + logarithms + more)
                found.append(LevelField(score, length, nugget, variance, table[:, 1:], slope))
    return max(found, key=lambda one: one.score)


def _factor(distance: np.ndarray, length: float, nugget: float) -> Factor:
    covariance = np.exp(-distance / length)
    covariance[np.diag_indices(len(covariance))] += nugget
    return Factor.from_gram(torch.from_numpy(covariance))

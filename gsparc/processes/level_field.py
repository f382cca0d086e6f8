"""Levels as a field over places: correlated exponentially, noise,
and a mean that is linear in regressors.

Correlation is Gudmundson's (Electronics Letters 27, 1991). Its length, and how strong the noise is
beside it, are those of most likelihood on a grid: for questions about data,
which finer ones answer no better.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gsparc.processes.factor import Factor
from gsparc.processes.kernel import ExponentialShadowing, Kernel

REACHES = (1 / 3, 1 / 10, 1 / 30, 1 / 100)  # lengths of correlation, parts of the region
NUGGETS = (0.05, 0.2, 0.7, 3.0)  # variance of fading and noise, parts of that of shadowing
SPREADS = (0.1, 1.0, 10.0, 100.0)  # variance of the groups' constants, parts of that of shadowing


@dataclass(frozen=True)
class LevelField:
    """The likeliest settings, and the regressors.

    Attributes:
        score: logarithm of the likelihood, less half of that of the rows for each slope.
        kernel: of the correlated field [m, dB^2], and of noise.
        columns: (n, k) regressors.
        slope: (k,) of them.
    """

    score: float
    kernel: Kernel
    columns: np.ndarray
    slope: np.ndarray

    @property
    def regression(self) -> np.ndarray:
        """What the regressors add (n,)."""
        return self.columns @ self.slope

    def precision(self, place: np.ndarray) -> np.ndarray:
        """Return the inverse covariance (m, m) [1/dB^2] of levels at places (m, d) [m]."""
        gram = self.kernel.gram(torch.from_numpy(place))
        return Factor.from_gram(gram).inverse.numpy() / self.kernel.amplitude


def fit_level_field(
    place: np.ndarray,
    level: np.ndarray,
    group: np.ndarray,
    columns: Sequence[np.ndarray] = (),
    nuggets: Sequence[float] = NUGGETS,
) -> LevelField:
    """Fit a field and a constant for each of groups, and slopes of columns over all of them.

    Constants are random about a mean that nobody knows (restricted likelihood): many groups of few
    rows cost what they leave open, not half a logarithm of all rows each.

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
    parts = [np.flatnonzero(group == value) for value in np.unique(group)]
    fields = []
    for length in (max(reach * wide, 1e-9) for reach in REACHES):
        for nugget in nuggets:
            gram, logarithms, means = np.zeros((table.shape[1],) * 2), 0.0, []
            kernel = Kernel.from_length(length, nugget, term=ExponentialShadowing)
            for part in parts:
                factor = Factor.from_gram(kernel.gram(torch.from_numpy(place[part])))
                both = np.column_stack([np.ones(len(part)), table[part]])
                white = factor.whiten(torch.from_numpy(both)).numpy()
                precision = float(white[:, 0] @ white[:, 0])
                mean = white[:, 0] @ white[:, 1:] / precision
                values = white[:, 1:] - np.outer(white[:, 0], mean)
                gram += values.T @ values
                logarithms += 2 * float(factor.lower.diagonal().log().sum())
                means.append((precision, *mean))
            slope = np.linalg.pinv(gram[1:, 1:]) @ gram[1:, 0]
            rest = float(gram[0, 0] - slope @ gram[1:, 0])
            weight, constant = np.array(means)[:, 0], np.array(means)[:, 1:] @ np.r_[1.0, -slope]
            for spread in SPREADS:
                values = 1 / (spread + 1 / weight)
                between = float(values @ (constant - values @ constant / values.sum()) ** 2)
                variance = max((rest + between) / count, 1e-6)
                more = float(np.log1p(spread * weight).sum()) + math.log(values.sum())
                more += len(slope) * math.log(count)
                score = -0.5 * (count * math.log(variance) + logarithms + more)
                fields.append(
                    LevelField(score, replace(kernel, amplitude=variance), table[:, 1:], slope)
                )
    return max(fields, key=lambda one: one.score)

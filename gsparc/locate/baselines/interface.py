"""What every baseline of localisation is: a function `fit` of features of known places makes a `Locator`.

Features (n, P) are real, NaN where silent; places are (n, D) float64 [m]. What features were made of is the
caller's. `ValueError` of rows that cannot be learned from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from sklearn.model_selection import GroupKFold

Setting = TypeVar("Setting")
FOLDS = 5  # of places, that choose a setting
LOOKED_AT = 2_000  # rows that choose it
BELOW = 0.02  # of the range of values, that a silent one is put below the least


@dataclass(frozen=True)
class Estimate:
    """Places (m, D) [m]; log probabilities (m, G) over a `grid` (G, D), None where a method has none."""

    place: np.ndarray
    log_probability: np.ndarray | None = None
    grid: np.ndarray | None = None

    @classmethod
    def over(cls, grid: np.ndarray, density: np.ndarray) -> Estimate:
        """The mean place of log densities (m, G), up to a constant of each row, over places (G, D)."""
        found = density - density.max(1, keepdims=True)
        found -= np.log(np.exp(found).sum(1, keepdims=True))
        return cls(np.exp(found) @ grid, found, grid)


class Locator(Protocol):
    """A fitted baseline."""

    def locate(self, features: np.ndarray) -> Estimate:
        """Of features (m, P), NaN where silent."""


def floor_of(features: np.ndarray, places: np.ndarray) -> float:
    """What stands for silence: a little below the least value of training rows."""
    if features.ndim != 2 or len(features) != len(places) or not np.isfinite(features).any():
        shapes = f"{features.shape} at places {places.shape}"
        raise ValueError(f"features {shapes}: expected (n, P) and (n, D), and a value that is finite")
    return float(np.nanmin(features) - BELOW * np.ptp(features[np.isfinite(features)]))


def filled(features: np.ndarray, floor: float) -> np.ndarray:
    """Features (m, P) without gaps, float64."""
    return np.where(np.isfinite(features), features, floor).astype(np.float64)


def least_error(
    settings: Sequence[Setting], fit: Callable[[Setting, np.ndarray, np.ndarray], Locator],
    features: np.ndarray, places: np.ndarray,
) -> Setting:  # fmt: skip
    """The setting of least median error at places left out, a fifth at a time; the first of few places."""
    rows = np.random.default_rng(0).permutation(len(features))[:LOOKED_AT]
    group = np.unique(places[rows], axis=0, return_inverse=True)[1].reshape(-1)
    if len(settings) == 1 or group.max() + 1 < FOLDS:
        return settings[0]
    cuts = [(rows[a], rows[b]) for a, b in GroupKFold(FOLDS).split(rows, groups=group)]

    def error(setting: Setting) -> float:
        found = [fit(setting, features[a], places[a]).locate(features[b]).place - places[b] for a, b in cuts]
        return float(np.median(np.linalg.norm(np.concatenate(found), axis=1)))

    return min(settings, key=error)

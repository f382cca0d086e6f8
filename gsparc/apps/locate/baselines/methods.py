"""Nearest rows, a kernel density and a Gaussian process, from features to a place.

A method learns from features (n, P), NaN where silent, and their places (n, D) float64 [m]; what it returns
finds the places (m, D) of features (m, P). `ValueError` of rows that cannot be learned from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, TypeVar

import numpy as np
import torch
from scipy.special import softmax
from sklearn.metrics import pairwise_distances
from sklearn.model_selection import GroupKFold
from sklearn.neighbors import KNeighborsRegressor

from gsparc.apps.locate.shared_kernel import settings, stretched
from gsparc.processes.nearest import Values, given

Locator = Callable[[np.ndarray], np.ndarray]  # features to places
Fit = Callable[[np.ndarray, np.ndarray], Locator]  # of features without gaps, and their places
Setting = TypeVar("Setting")

FOLDS = 5  # of places, that choose a setting
MAX_ROWS = 2_000  # that choose it
BELOW = 0.02  # of the range of values, that a silent one is put below the least
COUNTS = (1, 2, 3, 4, 5, 7, 9, 13)  # of neighbours
WIDTHS = (3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0)  # of the kernel [units of a feature]


def without_gaps(fit: Fit, features: np.ndarray, places: np.ndarray) -> Locator:
    """Fitted to features (n, P) in which silence is a little below the least value of these rows."""
    if features.ndim != 2 or len(features) != len(places) or not np.isfinite(features).any():
        shapes = f"{features.shape} at places {places.shape}"
        raise ValueError(f"features {shapes}: expected (n, P) and (n, D), and a value that is finite")
    floor = float(np.nanmin(features) - BELOW * np.ptp(features[np.isfinite(features)]))

    def filled(rows: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(rows), rows, floor).astype(np.float64)

    locate = fit(filled(features), places)
    return lambda rows: locate(filled(rows))


def least_error(
    settings: Sequence[Setting], fit: Callable[[Setting, np.ndarray, np.ndarray], Locator],
    features: np.ndarray, places: np.ndarray,
) -> Setting:  # fmt: skip
    """Return the setting of least median error at places left out, a fifth at a time; else the first."""
    rows = np.random.default_rng(0).permutation(len(features))[:MAX_ROWS]
    group = np.unique(places[rows], axis=0, return_inverse=True)[1].reshape(-1)
    if len(settings) == 1 or group.max() + 1 < FOLDS:
        return settings[0]
    folds = [(rows[a], rows[b]) for a, b in GroupKFold(FOLDS).split(rows, groups=group)]

    def error(setting: Setting) -> float:
        errors = [
            without_gaps(partial(fit, setting), features[a], places[a])(features[b]) - places[b]
            for a, b in folds
        ]
        return float(np.median(np.linalg.norm(np.concatenate(errors), axis=1)))

    return min(settings, key=error)


def mean_place(log_density: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Mean places (m, D) of log densities (m, G), up to a constant of each row, over places (G, D)."""
    return softmax(log_density, axis=1) @ grid


def neighbours(
    features: np.ndarray, places: np.ndarray, counts: Sequence[int] = COUNTS,
    weights: Literal["uniform", "distance"] = "distance",
) -> Locator:  # fmt: skip
    """Locate at the mean place of the best number of nearest rows, alike or by their inverse distances.

    P. Bahl and V. Padmanabhan, "RADAR: an in-building RF-based user location and tracking system", INFOCOM
    2000.
    """

    def fit(count: int, rows: np.ndarray, places: np.ndarray) -> Locator:
        count = min(count, len(rows))
        return KNeighborsRegressor(count, weights=weights, algorithm="brute").fit(rows, places).predict

    return without_gaps(partial(fit, least_error(counts, fit, features, places)), features, places)


def kernel(features: np.ndarray, places: np.ndarray, widths: Sequence[float] = WIDTHS) -> Locator:
    """Fit a density of features at each training place: a Gaussian kernel of the best width about each row.

    T. Roos et al., "A probabilistic approach to WLAN user location estimation", Int. J. Wireless Information
    Networks 9 (2002).
    """

    def fit(width: float, rows: np.ndarray, places: np.ndarray) -> Locator:
        grid, group, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        ordered = rows[np.argsort(group.reshape(-1), kind="stable")]
        first = np.cumsum(count) - count

        def locate(query: np.ndarray) -> np.ndarray:
            squared = pairwise_distances(query, ordered, "sqeuclidean")
            density = np.logaddexp.reduceat(-0.5 * squared / width**2, first, axis=1)
            return mean_place(density - np.log(count), grid)

        return locate

    return without_gaps(partial(fit, least_error(widths, fit, features, places)), features, places)


def process(features: np.ndarray, places: np.ndarray, seed: int = 0) -> Locator:
    """Fit a Gaussian process to each feature, all of one kernel; features at a training place are Gaussian.

    B. Ferris et al., "Gaussian processes for signal strength-based location estimation", RSS 2006.
    """

    def fit(rows: np.ndarray, places: np.ndarray) -> Locator:
        values = torch.from_numpy(rows - rows.mean(0)).float()
        prior, vertical = settings(values, places, seed)
        posterior = given(prior, Values.of(stretched(places, vertical), values), seed)
        grid = np.unique(places, axis=0)
        estimate = posterior.answer(torch.from_numpy(stretched(grid, vertical)))
        left_out, left = posterior.left_out()
        # One amplitude for all features, of what the process misses at places left out.
        amplitude = float(((posterior.rest - left_out).square().mean(1) / left).mean())
        mean, variance = estimate.mean.numpy() + rows.mean(0), amplitude * estimate.left.numpy()

        def locate(query: np.ndarray) -> np.ndarray:
            squared = pairwise_distances(query, mean, "sqeuclidean")
            return mean_place(-0.5 * (squared / variance + mean.shape[1] * np.log(variance)), grid)

        return locate

    return without_gaps(fit, features, places)

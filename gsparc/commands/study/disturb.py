"""Measurements with known errors, and fewer of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold


def displaced(data: Measurements, rows: np.ndarray, error_m: float, seed: int) -> Measurements:
    """The moving end of `rows` believed elsewhere by N(0, error_m^2) per coordinate; all else the same."""
    offset = np.random.default_rng(seed).normal(scale=error_m, size=(len(rows), 3))
    name = "tx" if data.site.moving_end == "tx" else "rx_position"
    moved = getattr(data, name).copy()
    moved[rows] += offset
    return replace(data, **{name: moved})


def turned(
    data: Measurements, error_deg: float, seed: int, *, missing: float = 0.0, false: float = 0.0
) -> Measurements:
    """Directions of arrival as a receiver measures them; all else the same.

    Args:
        data: with directions.
        error_deg: standard deviation about each of two axes across a direction [degrees].
        seed: of the draw.
        missing: share of the directions that are not there.
        false: number of directions from anywhere, as a share of those that are there.

    Raises:
        ValueError: no directions.
    """
    if data.directions is None:
        raise ValueError(f"{data.site.name}: no directions of arrival to disturb; take kind.errors_deg=[]")
    rng, sigma = np.random.default_rng(seed), np.radians(error_deg)
    measured = []
    for true in data.directions:
        ray = true.astype(np.float64)
        aside = rng.normal(scale=sigma, size=ray.shape)
        ray = ray + aside - (aside * ray).sum(1, keepdims=True) * ray
        ray = ray[rng.random(len(ray)) >= missing]
        ray = np.concatenate([ray, rng.normal(size=(rng.binomial(len(ray), false), 3))])
        measured.append((ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32))
    return replace(data, directions=measured)


def thinned(fold: Fold, keep: float, seed: int) -> Fold:
    """A fold with fewer rows to learn from; smaller ones are subsets of larger ones of the same seed.

    Args:
        fold: its training and validation rows are thinned alike, its test rows stay.
        keep: a share of the rows up to 1; above, a number of rows.
        seed: of the choice.
    """
    every = len(fold.train) + len(fold.val)
    total = min(round(keep * every if keep <= 1 else keep), every)
    validate = min(max(round(total * len(fold.val) / every), 1), len(fold.val))
    rng = np.random.default_rng([seed, 4])
    train, val = (rng.permutation(rows) for rows in (fold.train, fold.val))
    return Fold(np.sort(train[: max(total - validate, 1)]), np.sort(val[:validate]), fold.test)

"""A hall of access points: levels, silence, floors and walks whose places are known."""

import numpy as np

from gsparc.datasets.fingerprints import Fingerprints


def invented(count: int, floors: int = 1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Levels of 12 access points in a hall of 30 x 20 m, silent below -80 dBm, and their places."""
    rng = np.random.default_rng(seed)
    size = np.array([30, 20, 1.0])
    places = rng.uniform(0, 1, (count, 3)) * size
    places[:, 2] = 4.0 * rng.integers(0, floors, count)
    where = np.random.default_rng(9).uniform(0, 1, (12, 3)) * size
    apart = np.linalg.norm(places[:, None] - where, axis=2)
    level = -35 - 32 * np.log10(np.maximum(apart, 1)) + rng.normal(0, 2, apart.shape)
    level -= 3.0 * np.abs(places[:, None, 2] - where[:, 2])
    return np.where(level > -80, level, np.nan).astype(np.float32), places


def rows_of(level: np.ndarray, places: np.ndarray, walk: int = 30) -> Fingerprints:
    count = len(level)
    none, number = np.zeros(count, np.int64), np.arange(count)
    names = np.arange(level.shape[1]).astype(str)
    return Fingerprints(
        level, places, none, none, number // walk, none, none > 0, number.astype(float), names
    )


def walks(count: int, seed: int) -> Fingerprints:
    """Straight walks of 30 rows through the hall of `invented`."""
    rng, size = np.random.default_rng(seed), np.array([30.0, 20, 0])
    ends = rng.uniform(0.05, 0.95, (count, 2, 3)) * size
    places = (ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * np.linspace(0, 1, 30)[:, None]).reshape(
        -1, 3
    )
    level, _ = invented(1)  # for its access points
    where = np.random.default_rng(9).uniform(0, 1, (level.shape[1], 3)) * [30, 20, 1]
    apart = np.linalg.norm(places[:, None] - where, axis=2)
    heard = -35 - 32 * np.log10(np.maximum(apart, 1)) + rng.normal(0, 4, apart.shape)
    return rows_of(np.where(heard > -80, heard, np.nan).astype(np.float32), places)

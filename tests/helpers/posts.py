"""Powers at stations above a square of 20 m, by free space and a constant of each."""

from collections.abc import Callable
from typing import Any

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.tables.own import from_arrays

POSTS = np.array([[0.0, 0, 5], [20, 0, 5], [0, 20, 5], [20, 20, 5]])


def walked(count: int = 60) -> np.ndarray:
    """Places (count, 3) [m] of the end that moves."""
    return np.random.default_rng(0).uniform([0, 0, 1], [20, 20, 2], (count, 3))


def distances(count: int = 60, posts: np.ndarray = POSTS) -> np.ndarray:
    """Of the places from posts (P, 3): (count, P) [m]."""
    return np.linalg.norm(walked(count)[:, None] - posts, axis=-1)


def free_space(far: np.ndarray) -> np.ndarray:
    """Powers [dB] at distances [m]."""
    return -20 * np.log10(far)


def heard(
    count: int = 60,
    posts: np.ndarray = POSTS,
    rssi_db: Callable = free_space,
    end: str = "tx",
    **more: Any,
) -> Measurements:
    """Powers of posts (P, 3) by distances, or what `more` gives: `csi` takes their place."""
    arrays = {f"{end}_position": walked(count), "station_position": posts, **more}
    if "csi" not in more:
        arrays["rssi_db"] = rssi_db(distances(count, posts))
    return from_arrays(arrays)

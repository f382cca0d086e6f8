"""Groups of places apart, left out whole: whether a prior predicts where nobody measured nearby."""

from __future__ import annotations

import numpy as np

from gsparc.data import spacing
from gsparc.processes.places import first_end, horizontal
from gsparc.processes.trend import TINY_M

SIDES = 10  # squares along the longer side of the places' box
SPREAD = 0.25  # deviation of a prior on what share of a mean a prediction has


def number_squares(places: np.ndarray, sides: int = SIDES) -> np.ndarray:
    """Return the number (n,) int64 of the square of floor that each of places (n, 3), or (n, 6),
    lies in.

    Along the longer side of the places' box there are `sides` squares.
    """
    floor = horizontal(first_end(places))
    side = max(spacing.tenth_of_extent(floor), TINY_M) * SIDES / sides
    return spacing.number_squares(floor - floor.min(0), side)


def split_groups(group: np.ndarray, count: int, seed: int) -> list[np.ndarray]:
    """Return `count` parts of rows (n,), none empty unless there are fewer groups;
    groups stay whole.
    """
    names = np.random.default_rng(seed).permutation(int(group.max()) + 1)
    parts = [np.flatnonzero(np.isin(group, names[k::count])) for k in range(count)]
    return [part for part in parts if len(part)]

"""Groups of places apart, left out whole: whether a prior predicts where nobody measured nearby."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsparc.processes.places import horizontal, moving_end
from gsparc.processes.trend import TINY_M

SIDES = 10  # squares along the longer side of the places' box
SPREAD = 0.25  # deviation of a prior on what share of a mean a prediction has


@dataclass(frozen=True)
class ErrorGain:
    """What one prior gains over another at rows left out.

    Attributes:
        squares: mean of the squared errors of the other less those of the one [dB^2].
        error: standard error of that, groups taken as independent.
        others: mean of the squared errors of the other [dB^2].
    """

    squares: float
    error: float
    others: float

    def exceeds(self, errors: float) -> bool:
        """Tell whether it is more than so many standard errors."""
        return self.squares > errors * self.error


def number_squares(places: np.ndarray, sides: int = SIDES) -> np.ndarray:
    """Return the number (n,) int64 of the square of floor that each of places (n, 3), or (n, 6), lies in.

    Along the longer side of the places' box there are `sides` squares.
    """
    floor = horizontal(moving_end(places))
    side = max(float(np.ptp(floor, axis=0).max()), TINY_M) / sides
    cell = np.floor((floor - floor.min(0)) / side).clip(max=sides - 1).astype(np.int64)
    return np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)


def split_groups(group: np.ndarray, count: int, seed: int) -> list[np.ndarray]:
    """Return `count` parts of rows (n,), none empty unless there are fewer groups; groups stay whole."""
    names = np.random.default_rng(seed).permutation(int(group.max()) + 1)
    parts = [np.flatnonzero(np.isin(group, names[k::count])) for k in range(count)]
    return [part for part in parts if len(part)]


def compare_errors(first: np.ndarray, second: np.ndarray, group: np.ndarray) -> ErrorGain:
    """Return what `first` gains, by squared errors (n,) [dB^2] of both at rows left out in groups (n,)."""
    gain = second - first
    total = np.bincount(group, gain - gain.mean())
    return ErrorGain(float(gain.mean()), math.sqrt(float((total**2).sum())) / len(gain), float(second.mean()))

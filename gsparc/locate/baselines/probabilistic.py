"""A density of features at each training place: a Gaussian kernel about each row that was measured there.

T. Roos et al., "A probabilistic approach to WLAN user location estimation", Int. J. Wireless Information
Networks 9 (2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.metrics import pairwise_distances

from gsparc.locate.baselines.interface import Estimate, filled, floor_of, least_error

WIDTHS = (3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0)  # of the kernel [units of a feature], to choose among


@dataclass(frozen=True)
class Densities:
    """Features (n, P) in the order of their places (G, D) [m], the first row of each, the kernel's width."""

    rows: np.ndarray
    first: np.ndarray
    grid: np.ndarray
    floor: float
    width: float

    def locate(self, features: np.ndarray) -> Estimate:
        """See `Locator`."""
        squared = pairwise_distances(filled(features, self.floor), self.rows, "sqeuclidean")
        each = np.logaddexp.reduceat(-0.5 * squared / self.width**2, self.first, axis=1)
        return Estimate.over(self.grid, each - np.log(np.diff([*self.first, len(self.rows)])))


def fit(features: np.ndarray, places: np.ndarray, widths: Sequence[float] = WIDTHS) -> Densities:
    """With the best of some widths at places left out."""
    return _densities(least_error(widths, _densities, features, places), features, places)


def _densities(width: float, features: np.ndarray, places: np.ndarray) -> Densities:
    floor = floor_of(features, places)
    grid, group = np.unique(places, axis=0, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    first = np.searchsorted(group.reshape(-1)[order], np.arange(len(grid)))
    return Densities(filled(features, floor)[order], first, grid, floor, width)

"""The k rows of nearest features, alike or weighted by the inverse of their distance.

P. Bahl and V. Padmanabhan, "RADAR: an in-building RF-based user location and tracking system", INFOCOM 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.neighbors import NearestNeighbors

from gsparc.locate.baselines.interface import Estimate, filled, floor_of, least_error

COUNTS = (1, 2, 3, 4, 5, 7, 9, 13)


@dataclass(frozen=True)
class Near:
    """Features of rows, their places (n, D) [m], what stands for silence, k, whether near rows count more."""

    rows: NearestNeighbors
    places: np.ndarray
    floor: float
    count: int
    weighted: bool

    def locate(self, features: np.ndarray) -> Estimate:
        """See `Locator`."""
        known = filled(features, self.floor)
        distance, row = self.rows.kneighbors(known, min(self.count, len(self.places)))
        weight = 1 / np.maximum(distance, 1e-9) if self.weighted else np.ones_like(distance)
        return Estimate(np.einsum("mk,mkd->md", weight / weight.sum(1, keepdims=True), self.places[row]))


def fit(
    features: np.ndarray, places: np.ndarray, counts: Sequence[int] = COUNTS, weighted: bool = True
) -> Near:
    """With the best of some k at places left out; (1,) is the nearest."""

    def near(count: int, features: np.ndarray, places: np.ndarray) -> Near:
        floor = floor_of(features, places)
        rows = NearestNeighbors(algorithm="brute").fit(filled(features, floor))
        return Near(rows, places, floor, count, weighted)

    return near(least_error(counts, near, features, places), features, places)

"""Which errors of a map go together: near places by the model, regions nobody walked by quarters.

What a region lacks (its terrain, the phone, the gain of a cell) is one error of all its places. How
much of the variance that is, is learned from quarters of the places, each predicted from the
others: products of errors of two rows, over all pairs of a quarter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from gsparc.apps.maps.promise import Promise
from gsparc.prediction.predictor import Predictor

MOST = 0.95  # of a variance, that a region shares


@dataclass(frozen=True)
class RegionErrors:
    """What errors far from all measurements have in common.

    Attributes:
        all: share of their variance that all stations' errors have in common there.
        each: what those of one station have in common besides.
        near_m: from what was measured, where half of it counts [m].
        length_m: over which a region's error changes [m].
        quarters: that tell so; 0: none, and nothing is shared.
    """

    all: float = 0.0
    each: float = 0.0
    near_m: float = 1.0
    length_m: float = 1.0
    quarters: int = 0

    @classmethod
    def from_promise(cls, promise: Promise | None) -> RegionErrors:
        """Return what held-out quarters tell."""
        rows = None if promise is None else promise.quarters
        if promise is None or rows is None or not rows.heard.any():
            return cls()
        rows = rows.subset(rows.heard)
        deviation = promise.calibration().half_and_error(
            rows.spread_db, rows.distance, rows.station
        )[1]
        known = np.isfinite(deviation)
        rows, near = rows.subset(known), promise.block_m
        weight = deviation[known] * np.sqrt(rows.distance / (rows.distance + near))
        error, quarters = rows.level_db - rows.mean_db, len(np.unique(rows.block))
        pairs = [_pairs(error * weight, weight**2, rows.block)]
        cell = rows.block * (int(rows.station.max()) + 1) + rows.station
        pairs.append(_pairs(error * weight, weight**2, cell))
        same = pairs[1][0] / max(pairs[1][1], 1e-12)
        other = pairs[0][1] - pairs[1][1]
        # Of one station the two are not told apart: all of it is that station's.
        shared = (pairs[0][0] - pairs[1][0]) / other if other > 0 else same
        total = float(np.clip(same, 0.0, MOST))
        common = float(np.clip(shared, 0.0, total))
        length = float(np.ptp(promise.known[:, -3:-1], axis=0).max()) / 2
        return cls(common, total - common, near, max(length, 1e-6), quarters)

    def weights(self, distance: np.ndarray) -> np.ndarray:
        """Return what part (n,) of the shares counts, so far from what was measured [m]."""
        return np.asarray(distance / (distance + self.near_m))

    def correlations(
        self, alike: np.ndarray, places: np.ndarray, number: np.ndarray, distance: np.ndarray
    ) -> np.ndarray:
        """Return correlations (n, n) of errors, of which `alike` (n, n) are the model's own.

        Args:
            alike: as the model states them.
            places: (n, 3) world [m].
            number: (n,) of the station of each.
            distance: (n,) from what was measured of it [m].
        """
        far = np.where(np.isfinite(distance), self.weights(distance), 1.0)
        # Smooth, since a region has one error and its neighbour a similar one.
        region = np.exp(-0.5 * cdist(places, places, "sqeuclidean") / self.length_m**2)
        common = (self.all + self.each * (number[:, None] == number)) * region
        own = np.sqrt(1 - (self.all + self.each) * far)
        root = np.sqrt(far)
        return np.asarray(own * own[:, None] * alike + root * root[:, None] * common)


def _pairs(product: np.ndarray, square: np.ndarray, group: np.ndarray) -> tuple[float, float]:
    """Sums over pairs of rows of one group (n,) of products of both, and of their squares."""
    each = np.unique(group, return_inverse=True)[1].reshape(-1)
    sums = (np.bincount(each, part) ** 2 for part in (product, square))
    own = (np.bincount(each, part**2) for part in (product, square))
    top, bottom = (float((whole - part).sum()) for whole, part in zip(sums, own, strict=True))
    return top, bottom


def model_correlations(
    predictor: Predictor, places: np.ndarray, number: np.ndarray, block_m: float
) -> np.ndarray:
    """Return correlations (n, n) of errors of stations (n,) at places (n, 3), by the model alone;
    variances alone hold the noise.
    """
    if (joint := predictor.predict_joint(places[None], number)) is None:
        # Of 32 simulated shares 24 lay in these intervals,
        # 23 in those by each station's own process.
        return np.where(number[:, None] == number, shadowing(places, block_m), 0.0)
    variance = joint.covariance[0].diagonal()
    return (joint.covariance[0] - np.diag(joint.noise)) / np.sqrt(np.outer(variance, variance))


def shadowing(places: np.ndarray, block_m: float) -> np.ndarray:
    """Return correlations (n, n) of errors at places (n, 3),
    which decay over a block as shadowing does.
    """
    return np.exp(-cdist(places, places) / block_m)

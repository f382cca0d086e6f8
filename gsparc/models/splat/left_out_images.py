"""Training images predicted without their neighbours, by whatever is linear in them,
and by a plain process.

Plain leave-one-out tests interpolation over the spacing of the samples only: here each sample is
predicted without all others within a gap, for several gaps, so that rows can be chosen that are as
far from what is left as queries will be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.distance import cdist

from gsparc.processes.factor import Factor
from gsparc.processes.fit_kernel import choose_left_out_kernel
from gsparc.processes.left_out import left_out_around
from gsparc.processes.stored import Stored

LEAST = 1e-9  # of a distance [m] and of a squared error: their logarithms stay finite


@dataclass(frozen=True)
class LeftOut(Stored):
    """Training spectra predicted without their neighbours.

    Attributes:
        positions: (n, 3) [m].
        images: (n, P) float64, some pixels of the spectra.
        centres: (c,) rows that were held out.
        gaps: (g,) [m] within which their neighbours were held out, too.
        predicted: (g, c, P); NaN where no sample was left.
    """

    positions: np.ndarray
    images: np.ndarray
    centres: np.ndarray
    gaps: np.ndarray
    predicted: np.ndarray

    def predict_by_process(self) -> np.ndarray:
        """Return the same samples (g, c, P) as a Gaussian process
        on images predicts them from the rest.
        """
        mean = self.images.mean(0)
        vectors, lengths, _ = np.linalg.svd(self.images - mean, full_matrices=False)
        # Left singular vectors times singular values are scores in an orthonormal basis.
        kernel = choose_left_out_kernel(self.positions, vectors * lengths, len(mean))
        inverse = Factor.from_gram(kernel.gram(torch.from_numpy(self.positions))).inverse.numpy()
        distance = cdist(self.positions, self.positions)
        return (
            mean
            + means_and_variances(inverse, self.images - mean, distance, self.centres, self.gaps)[0]
        )

    def beside_process(self, distance: float | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return predictions, those of a process, and targets (n, P)
        of samples that anything is left for.

        At the gap of `nearest_gap`.
        """
        gap = self.nearest_gap(distance)
        both = self.predicted[gap], self.predict_by_process()[gap]
        seen = ~np.isnan(both).any((0, 2))
        return both[0][seen], both[1][seen], self.images[self.centres][seen]

    def nearest_gap(self, distance: float | None) -> int:
        """Return the gap whose held-out samples are most nearly `distance` [m] from the rest,
        by medians.

        Args:
            distance: of rows held out of the fit to the nearest row in it; None: no gap at all.
        """
        if distance is None:
            return 0
        separation = cdist(self.positions[self.centres], self.positions)
        # A row is not its own neighbour.
        separation[np.arange(len(separation)), self.centres] = np.inf
        beyond = [np.where(separation > gap, separation, np.inf).min(1) for gap in self.gaps]
        medians = np.array([np.median(nearest) for nearest in beyond])
        # By ratio: twice as far and half as far are equally wrong.
        return int(np.argmin(np.abs(np.log(medians + LEAST) - np.log(distance + LEAST))))


def means_and_variances(
    inverse: np.ndarray,
    values: np.ndarray,
    distance: np.ndarray,
    centres: np.ndarray,
    gaps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and variance of each sample given all others outside a gap around it.

    Without the set S the residual of its members is `(K^-1_SS)^-1 (K^-1 X)_S`, their covariance
    `(K^-1_SS)^-1`: small systems instead of one of n - |S| for each.

    Args:
        inverse: (n, n) of the Gram matrix with noise.
        values: (n, M) real or complex.
        distance: (n, n) [m].
        centres: (c,) rows.
        gaps: (g,) [m].

    Returns:
        Means (g, c, M), and variances (g, c) with noise; NaN where nothing is left.
    """
    precision, weighted = torch.from_numpy(inverse), torch.from_numpy(inverse @ values)
    mean = np.full((len(gaps), len(centres), values.shape[1]), np.nan, dtype=values.dtype)
    variance, rows = np.full(mean.shape[:2], np.nan), torch.from_numpy(centres)
    for g, gap in enumerate(gaps):
        near = distance[centres] <= gap
        near[np.arange(len(centres)), centres] = True
        # Rows with all others inside the gap have nothing to be predicted from: they stay NaN.
        some = np.flatnonzero(~near.all(1))
        result = left_out_around(precision, weighted, rows[some], torch.from_numpy(near[some]))
        mean[g, some], variance[g, some] = (
            values[centres[some]] - result[0].numpy(),
            result[1].numpy(),
        )
    return mean, variance


def mean_log_error(error: np.ndarray) -> float:
    """Return the mean over gaps and centres of the log of squared errors (g, c),
    NaN where there are none.
    """
    usable = ~np.isnan(error).all(1)
    return float(np.nanmean(np.log(error[usable] + LEAST), axis=1).mean()) if usable.any() else 0.0

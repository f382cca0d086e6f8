"""Gaussians as a picture or a file needs them, whatever model they are of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GaussianCloud:
    """N Gaussians in the local coordinates of a site.

    Attributes:
        means: (N, 3) float64 [m].
        scales: (N, 3) float64, standard deviations along their own axes [m].
        quats: (N, 4) float64, unit (w, x, y, z), own axes to local.
        opacities: (N,) float64 in [0, 1].
        strengths: (N,) float64, what each emits or takes, in the unit of `label`.
        label: of the strengths, with the unit.
    """

    means: np.ndarray
    scales: np.ndarray
    quats: np.ndarray
    opacities: np.ndarray
    strengths: np.ndarray
    label: str

    def __len__(self) -> int:
        return len(self.means)

    def covariances(self) -> np.ndarray:
        """(N, 3, 3) [m^2]: R S S R^T (Kerbl et al. 2023, eq. 6)."""
        w, x, y, z = self.quats.T
        turn = np.stack(
            [
                1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
            ],
            axis=-1,
        ).reshape(-1, 3, 3)  # fmt: skip
        half = turn * self.scales[:, None, :]
        return np.asarray(half @ half.transpose(0, 2, 1))

"""What a field found to stand in a site (mirror planes, boxes), and Gaussians as they are shown."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class SiteObjects:
    """In the local coordinates of a site, float64.

    Attributes:
        planes: (P, 4) of mirrors, see `gsparc.physics.mirror_planes` [unit normal; m].
        boxes: (B, 2, 3) lower and upper corners of what lets nothing through [m].
    """

    planes: np.ndarray
    boxes: np.ndarray

    @classmethod
    def from_arrays(
        cls, planes: np.ndarray | None = None, boxes: np.ndarray | None = None
    ) -> SiteObjects:
        """Build from planes (P, 4) and boxes (B, 2, 3); None: there are none."""
        planes = np.zeros((0, 4)) if planes is None else planes
        return cls(planes, np.zeros((0, 2, 3)) if boxes is None else boxes)

    def __len__(self) -> int:
        return len(self.planes) + len(self.boxes)

    def joined(self, other: SiteObjects) -> SiteObjects:
        """Join these and others."""
        both = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return SiteObjects(*(np.concatenate(pair) for pair in both))


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
        """Return covariances (N, 3, 3) [m^2]: R S S R^T (Kerbl et al. 2023, eq. 6)."""
        turn = Rotation.from_quat(np.roll(self.quats, -1, axis=1)).as_matrix()
        half = turn * self.scales[:, None, :]
        return np.asarray(half @ half.transpose(0, 2, 1))

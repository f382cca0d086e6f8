"""What a field found to stand in a site: mirror planes, boxes, and Gaussians that paths lose power in."""

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
        means: (N, 3) of Gaussians in the way [m].
        scales: (N, 3) their standard deviations along their own axes, the third upwards [m].
        turns: (N,) angles from x to their first axes [rad].
        losses: (N,) what the straight path through the middle of each loses [dB]; negative: gains.
    """

    planes: np.ndarray
    boxes: np.ndarray
    means: np.ndarray
    scales: np.ndarray
    turns: np.ndarray
    losses: np.ndarray

    @classmethod
    def of(
        cls,
        planes: np.ndarray | None = None,
        boxes: np.ndarray | None = None,
        gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> SiteObjects:
        """Planes (P, 4), boxes (B, 2, 3), Gaussians as means, scales, turns, losses; None: there are none."""
        flat = np.zeros(0)
        planes = np.zeros((0, 4)) if planes is None else planes
        boxes = np.zeros((0, 2, 3)) if boxes is None else boxes
        return cls(planes, boxes, *(gaussians or (flat.reshape(0, 3), flat.reshape(0, 3), flat, flat)))

    def __len__(self) -> int:
        return len(self.planes) + len(self.boxes) + len(self.means)

    def joined(self, other: SiteObjects) -> SiteObjects:
        """These and others."""
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
        """(N, 3, 3) [m^2]: R S S R^T (Kerbl et al. 2023, eq. 6)."""
        turn = Rotation.from_quat(np.roll(self.quats, -1, axis=1)).as_matrix()
        half = turn * self.scales[:, None, :]
        return np.asarray(half @ half.transpose(0, 2, 1))

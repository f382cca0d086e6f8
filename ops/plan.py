"""Geometry of a view: footprints, visibility and depth order, independent of the features."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.settings import Optics


@dataclass(frozen=True)
class Plan:
    """Footprints of N Gaussians for P poses, ordered and binned; bookkeeping without gradients.

    Valid for the geometry and opacities it was made from, and for nothing else.

    Attributes:
        pose: P poses; one without a leading axis is shared by a whole batch.
        grid, optics: pixel directions and projection it was made for.
        backend: name of the backend that made it; the same one must composite it.
        means2d: (P, N, 2) (column, row) [px].
        radii: (P, N) [px], 0 where culled.
        visible: (P, N) bool.
        buffers: the backend's own tensors.
        pose_trained: whether the poses it was given require gradients, of which there are none.
    """

    pose: Pose
    grid: SphereGrid
    optics: Optics
    backend: str
    means2d: Tensor
    radii: Tensor
    visible: Tensor
    buffers: tuple[Tensor, ...]
    pose_trained: bool = False

    @property
    def num_gaussians(self) -> int:
        """N."""
        return self.means2d.shape[1]

    @property
    def num_poses(self) -> int:
        """P."""
        return self.means2d.shape[0]

"""Plans and outputs of the rasterizer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.settings import FAINTEST, KernelSettings, Optics, kernel_settings


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
        buffers: the backend's own tensors: `operators.Buffers`, or of the reference the depth order
            alone.
        pose_trained: whether the poses it was given require gradients, of which there are none.
    """

    pose: Pose
    grid: SphereGrid
    optics: Optics
    backend: str
    means2d: Tensor
    radii: Tensor
    visible: Tensor
    buffers: Any
    pose_trained: bool = False

    @property
    def settings(self) -> KernelSettings:
        """Grid and optics as the kernels take them."""
        return kernel_settings(self.grid, self.optics)

    @property
    def num_gaussians(self) -> int:
        """N."""
        return self.means2d.shape[1]

    @property
    def num_poses(self) -> int:
        """P."""
        return self.means2d.shape[0]


@dataclass(frozen=True)
class Raster:
    """A rendered batch of B samples seen from P poses (P = 1 when the pose is shared, else P = B).

    Image and transmittance are differentiable. Radii, visible and means2d belong to the plan:
    constants, whose derivative by a Gaussian is 0 in every mode.

    Attributes:
        image: (B, C, H, W), sum over Gaussians of transmittance before it, times alpha, times
            feature.
        transmittance: (P, H, W), what is left behind all Gaussians.
        radii: (P, N) [px], long half axis of the footprint at the cut-off; 0 where culled.
        visible: (P, N) bool, whether the footprint at the cut-off may reach a pixel of the grid.
        means2d: (P, N, 2) (column, row) [px]. After `backward` its `.grad` holds, per pose, the
            derivative by a shift of the footprint alone, before the chain into `means`. For
            `tangent` a pixel of that gradient is one elevation step in both directions,
            so that it does not fade at the zenith.
    """

    image: Tensor
    transmittance: Tensor
    radii: Tensor
    visible: Tensor
    means2d: Tensor


@dataclass(frozen=True)
class Weights:
    """How much of each Gaussian a receiver sees.

    Attributes:
        mean: (P, N), mean over pixels of alpha times transmittance.
        share: (P, N) in [0, 1], sum of alpha times transmittance over sum of alpha: the visible
            part of the footprint; 0 where there is no footprint.
            Below `FAINTEST` it has a value and no gradient.
    """

    mean: Tensor
    share: Tensor


def visible_share(seen: Tensor, total: Tensor) -> Tensor:
    """Return `Weights.share` of the sums over pixels of alpha T and of alpha.

    >>> visible_share(torch.tensor([0.2, 0.0]), torch.tensor([0.8, 0.0]))
    tensor([0.2500, 0.0000])
    """
    bright = total > FAINTEST
    part, whole = seen.detach(), total.detach()  # `no_grad` would let tangents through
    # `where` computes both branches: the inner one keeps 0 / 0 and its NaN gradient out.
    faint = torch.where(whole > 0, part / torch.where(whole > 0, whole, 1.0), 0.0)
    return torch.where(bright, seen / torch.where(bright, total, 1.0), faint)

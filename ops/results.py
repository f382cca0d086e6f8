"""Outputs of the rasterizer."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.ops.settings import FAINTEST


@dataclass(frozen=True)
class Raster:
    """A rendered batch of B samples seen from P poses (P = 1 when the pose is shared, else P = B).

    Image and transmittance are differentiable. Radii, visible and means2d belong to the plan: constants,
    whose derivative by a Gaussian is 0 in every mode.

    Attributes:
        image: (B, C, H, W), sum over Gaussians of transmittance before it, times alpha, times feature.
        transmittance: (P, H, W), what is left behind all Gaussians.
        radii: (P, N) [px], long half axis of the footprint at the cut-off; 0 where culled.
        visible: (P, N) bool, whether the footprint at the cut-off may reach a pixel of the grid.
        means2d: (P, N, 2) (column, row) [px]. After `backward` its `.grad` holds, per pose, the derivative by
            a shift of the footprint alone, before the chain into `means`. For `tangent` a pixel of
            that gradient is one elevation step in both directions, so that it does not fade at the zenith.
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
        share: (P, N) in [0, 1], sum of alpha times transmittance over sum of alpha: the visible part of the
            footprint; 0 where there is no footprint. Below `FAINTEST` it has a value and no gradient.
    """

    mean: Tensor
    share: Tensor


def visible_share(seen: Tensor, total: Tensor) -> Tensor:
    """`Weights.share` of the sums over pixels of alpha T and of alpha."""
    bright = total > FAINTEST
    part, whole = seen.detach(), total.detach()  # `no_grad` would let tangents through
    faint = torch.where(whole > 0, part / torch.where(whole > 0, whole, 1.0), 0.0)
    return torch.where(bright, seen / torch.where(bright, total, 1.0), faint)

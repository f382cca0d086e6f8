"""The kernels' functions in plain PyTorch, a few rows of the image at a time.

For what no kernel serves: forward mode and the transforms of `torch.func`. Exact in every order of
derivative, and far slower than a kernel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.ops import reference_backend
from gsparc.ops.geometry import Gaussians, SphereGrid
from gsparc.ops.results import Plan, Weights, visible_share

ELEMENTS = 2**22  # of a tensor Gaussians x pixels


def composite(
    plan: Plan, gaussians: Gaussians, features: Tensor, means2d: Tensor
) -> tuple[Tensor, Tensor]:
    """Return image (B, C, H, W), transmittance (P, H, W) of features (B, N, C),
    by any backend's plan.
    """
    parts = [
        reference_backend.composite(part, gaussians, features, means2d)
        for part in _split_rows(plan)
    ]
    images, transmittances = zip(*parts, strict=True)
    return torch.cat(images, -2), torch.cat(transmittances, -2)


def mean_weights(plan: Plan, gaussians: Gaussians) -> Weights:
    """Return the mean over pixels of alpha T, and its share of alpha: both (P, N)."""
    parts = [reference_backend.weight_sums(part, gaussians) for part in _split_rows(plan)]
    seen, total = (torch.stack(sums).sum(0) for sums in zip(*parts, strict=True))
    return Weights(seen / (plan.grid.height * plan.grid.width), visible_share(seen, total))


def _split_rows(plan: Plan) -> Iterator[Plan]:
    """The plan as the reference's, for stretches of rows that bound the memory."""
    # Of a kernel's plan the third buffer is `Buffers.order`.
    order = plan.buffers[0] if plan.backend == "reference" else plan.buffers[2].long()
    grid, count = plan.grid, max(1, ELEMENTS // max(1, plan.num_gaussians * plan.grid.width))
    for first in range(0, grid.height, count):
        rows = min(count, grid.height - first)
        start = grid.first_elevation + first * grid.elevation_step
        part = SphereGrid(
            rows, grid.width, start, grid.first_azimuth, grid.elevation_step, grid.azimuth_step
        )
        yield replace(plan, backend="reference", grid=part, buffers=(order,))

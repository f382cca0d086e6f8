"""The `cuda` backend: CUDA kernels for the operators, and frozen views."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import _native, cuda_kernels, cuda_library, operators
from gsparc.ops.geometry import Gaussians, SphereGrid
from gsparc.ops.operators import Buffers, Poses, check_memory, composite, make_plan, mean_weights
from gsparc.ops.plan import Plan
from gsparc.ops.settings import kernel_settings

__all__ = ["composite", "freeze", "load", "make_plan", "mean_weights", "thaw"]


def load() -> None:
    """Build or find the kernels and let them serve CUDA tensors (cuda_library.LibraryUnavailable)."""
    if "cuda" not in cuda_kernels.libraries:
        cuda_kernels.libraries["cuda"] = cuda_library.load()
        operators.KERNELS["cuda"] = cuda_kernels


def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Order (V,) of the visible Gaussians; tiles' starts and ends, each entry's rank and 32 weights."""
    settings, poses = kernel_settings(plan.grid, plan.optics), Poses(plan.pose.position, plan.pose.rotation)
    means, buffers, tiles = gaussians.means, Buffers(*plan.buffers), cuda_kernels.tiles(settings)
    capacity = cuda_kernels.capacity_of(buffers, 1, settings)
    pixels = _native.TILE_WIDTH * _native.TILE_HEIGHT
    check_memory(capacity, pixels * means.element_size())
    blocks = means.new_zeros(capacity, pixels)
    starts = buffers.entries[: tiles + 1].clone()
    ends = starts[:-1].clone()
    if len(means) > 0:
        cuda_kernels.run_on_plan("weights", buffers, gaussians, poses, settings, None, blocks, ends)
    order = buffers.order[0, : int(buffers.shown[0])].to(torch.int64)
    rank_of = order.new_zeros(len(means))
    rank_of[order] = torch.arange(len(order), device=order.device)
    of_entries = buffers.entries[tiles + 1 : tiles + 1 + capacity].to(torch.int64)
    return order, (starts, ends, rank_of[of_entries].to(torch.int32), blocks)


def thaw(grid: SphereGrid, buffers: tuple[Tensor, ...], features: Tensor) -> Tensor:
    """Image (K, H, W) of features (V, K) in the order of `freeze`, in its precision (TypeError)."""
    if features.dtype != buffers[3].dtype:
        raise TypeError(f"features are {features.dtype}, this view was frozen in {buffers[3].dtype}")
    features = features.contiguous()
    image = features.new_empty(features.shape[1], grid.height, grid.width)
    if image.numel():
        channels, height, width = image.shape
        cuda_kernels.run(
            *("thaw", features, *buffers, features, image), channels=channels, height=height, width=width
        )
    return image

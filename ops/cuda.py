"""The `cuda` backend: CUDA kernels for the operators, and frozen views."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import _native, calls, cuda_kernels, cuda_library
from gsparc.ops.geometry import Gaussians
from gsparc.ops.operators import Buffers, Poses, check_memory, composite, make_plan, mean_weights, thaw
from gsparc.ops.plan import Plan
from gsparc.ops.settings import kernel_settings

__all__ = ["composite", "freeze", "load", "make_plan", "mean_weights", "thaw"]


def load() -> None:
    """Build or find the kernels and let them serve CUDA tensors (cuda_library.LibraryUnavailable)."""
    if "cuda" not in calls.libraries:
        calls.libraries["cuda"] = cuda_library.load()


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
        view = {"buffers": buffers, "gaussians": gaussians, "poses": poses, "settings": settings}
        cuda_kernels.run_on_plan("weights", None, blocks, ends, **view)
    order = buffers.order[0, : int(buffers.shown[0])].to(torch.int64)
    rank_of = order.new_zeros(len(means))
    rank_of[order] = torch.arange(len(order), device=order.device)
    of_entries = buffers.entries[tiles + 1 : tiles + 1 + capacity].to(torch.int64)
    return order, (starts, ends, rank_of[of_entries].to(torch.int32), blocks)

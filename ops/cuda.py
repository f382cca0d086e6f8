"""The `cuda` backend: the operators on the CUDA kernels, and views frozen by them."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import cuda_kernels, cuda_library, operators
from gsparc.ops.cuda_kernels import TILE_HEIGHT, TILE_WIDTH
from gsparc.ops.geometry import SphereGrid
from gsparc.ops.operators import check_memory, composite, make_plan, mean_weights, model_of, numbers
from gsparc.ops.plan import Plan

__all__ = ["composite", "freeze", "load", "make_plan", "mean_weights", "thaw"]


def load() -> None:
    """Build or find the kernels and let them serve CUDA tensors (cuda_library.LibraryUnavailable)."""
    if "cuda" not in cuda_kernels.libraries:
        cuda_kernels.libraries["cuda"] = cuda_library.load()
        operators.KERNELS["cuda"] = cuda_kernels


def freeze(
    plan: Plan,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Order (V,) of the visible Gaussians; tiles' starts and ends, each entry's rank and 32 weights."""
    whole, real = numbers(plan.grid, plan.optics)
    buffers, tiles, n = plan.buffers, cuda_kernels.tiles(whole), means.shape[0]
    capacity = cuda_kernels.capacity_of(buffers, 1, whole)
    check_memory(capacity, TILE_WIDTH * TILE_HEIGHT * means.element_size())
    blocks = means.new_zeros(capacity, TILE_WIDTH * TILE_HEIGHT)
    starts = buffers[6][: tiles + 1].clone()
    ends = starts[:-1].clone()
    if n > 0:
        model = model_of(means, quats, scales, opacities, extinctions, plan.pose.position, plan.pose.rotation)
        tensors = [*cuda_kernels.view_of(means, buffers, whole, real), *model, None, blocks, ends]
        sizes = {"poses": 1, "count": n, "capacity": capacity}
        cuda_kernels.run("weights", means, *tensors, whole=whole, real=real, sizes=sizes)
    order = buffers[2][0, : int(buffers[3][0])].to(torch.int64)
    rank_of = order.new_zeros(n)
    rank_of[order] = torch.arange(len(order), device=order.device)
    gaussians = buffers[6][tiles + 1 : tiles + 1 + capacity].to(torch.int64)
    return order, (starts, ends, rank_of[gaussians].to(torch.int32), blocks)


def thaw(grid: SphereGrid, buffers: tuple[Tensor, ...], features: Tensor) -> Tensor:
    """Image (K, H, W) of features (V, K) in the order of `freeze`, in its precision (TypeError)."""
    if features.dtype != buffers[3].dtype:
        raise TypeError(f"features are {features.dtype}, this view was frozen in {buffers[3].dtype}")
    features = features.contiguous()
    image = features.new_empty(features.shape[1], grid.height, grid.width)
    whole = (grid.height, grid.width)
    if features.shape[1] > 0:
        cuda_kernels.run(
            "thaw", features, *buffers, features, image, whole=whole, sizes={"channels": features.shape[1]}
        )
    return image

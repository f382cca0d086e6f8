"""The `cpu` backend: C++ kernels for the operators, and frozen views."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import _native, cpu_kernels, operators
from gsparc.ops.cpu_kernels import addresses
from gsparc.ops.geometry import Gaussians, SphereGrid
from gsparc.ops.operators import (
    Buffers,
    check_memory,
    composite,
    contiguous,
    make_plan,
    mean_weights,
    strips,
)
from gsparc.ops.plan import Plan
from gsparc.ops.settings import kernel_settings

__all__ = ["composite", "freeze", "instruction_set", "make_plan", "mean_weights", "thaw"]

operators.KERNELS["cpu"] = cpu_kernels


def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Order (V,) of the visible Gaussians, and the weights alpha T as blocks of pixels; see frozen.h."""
    means, settings = gaussians.means, kernel_settings(plan.grid, plan.optics)
    inputs = [*plan.buffers, *contiguous((*gaussians, plan.pose.position, plan.pose.rotation))]
    head = (means.dtype == torch.float64, len(means), torch.get_num_threads(), settings)
    counts = torch.zeros(strips(plan.grid.height) + 1, dtype=torch.int64)
    lanes = _native.freeze(*head, addresses(*inputs, counts, None, None))
    starts = counts.cumsum(0)
    size = int(starts[-1])
    check_memory(size, 8 + lanes * means.element_size())
    heads, weights = torch.empty(size, 2, dtype=torch.int32), means.new_empty(size, lanes)
    if size > 0:
        _native.freeze(*head, addresses(*inputs, starts, heads, weights))
    buffers = Buffers(*plan.buffers)
    return buffers.order[0, : int(buffers.shown[0])].to(torch.int64), (starts, heads, weights)


def thaw(grid: SphereGrid, buffers: tuple[Tensor, ...], features: Tensor) -> Tensor:
    """Image (K, H, W) of features (V, K) in the order of `freeze`, in its precision (TypeError)."""
    if features.dtype != buffers[2].dtype:
        raise TypeError(f"features are {features.dtype}, this view was frozen in {buffers[2].dtype}")
    features = features.contiguous()
    image = features.new_empty(features.shape[1], grid.height, grid.width)
    double, threads = features.dtype == torch.float64, torch.get_num_threads()
    _native.thaw(double, *image.shape, threads, addresses(*buffers, features, image))
    return image


def instruction_set() -> str:
    """Name of the kernels in use: baseline, avx2 or avx512."""
    return _native.instruction_set()

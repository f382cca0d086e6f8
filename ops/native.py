"""The `cpu` backend: C++ kernels for the operators, and frozen views."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from gsparc.ops import _native, cpu_kernels
from gsparc.ops.geometry import Gaussians
from gsparc.ops.operators import (
    Buffers,
    Poses,
    check_memory,
    composite,
    make_plan,
    mean_weights,
    strips,
    thaw,
)
from gsparc.ops.plan import Plan
from gsparc.ops.settings import kernel_settings

__all__ = ["composite", "freeze", "instruction_set", "make_plan", "mean_weights", "thaw"]


def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Order (V,) of the visible Gaussians, and the weights alpha T as blocks of pixels; see frozen.h."""
    buffers = Buffers(*plan.buffers)

    run = partial(
        cpu_kernels.run_on_plan,
        "freeze",
        buffers=buffers,
        gaussians=gaussians,
        poses=Poses(plan.pose.position, plan.pose.rotation),
        settings=kernel_settings(plan.grid, plan.optics),
    )
    counts = torch.zeros(strips(plan.grid.height) + 1, dtype=torch.int64)
    lanes = run(counts, None, None)
    starts = counts.cumsum(0)
    size = int(starts[-1])
    check_memory(size, 8 + lanes * gaussians.means.element_size())
    heads, weights = torch.empty(size, 2, dtype=torch.int32), gaussians.means.new_empty(size, lanes)
    if size > 0:
        run(starts, heads, weights)
    return buffers.order[0, : int(buffers.shown[0])].to(torch.int64), (starts, heads, weights)


def instruction_set() -> str:
    """Name of the kernels in use: baseline, avx2 or avx512."""
    return _native.instruction_set()

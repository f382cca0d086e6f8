"""The `cpu` backend: the operators on CPU tensors by the C++ kernels, and frozen views."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, calls, validation
from gsparc.ops.geometry import Gaussians, Pose
from gsparc.ops.operators import (
    Buffers,
    Poses,
    check_memory,
    composite,
    contiguous,
    kernel,
    kernel_view,
    make_plan,
    mean_weights,
    strips,
    thaw,
)
from gsparc.ops.plan import Plan
from gsparc.ops.settings import KernelSettings

__all__ = ["composite", "freeze", "instruction_set", "make_plan", "mean_weights", "thaw"]


def run_on_plan(
    name: str,
    *tensors: Tensor | None,
    buffers: Buffers,
    gaussians: Gaussians,
    poses: Poses,
    settings: KernelSettings,
    sizes: Sequence[int] = (),
) -> int:
    """Call a kernel that begins with `ViewArgs` of csrc/layout.h, then `tensors`."""
    inputs = contiguous((*gaussians, *poses, *tensors))
    counts = (len(poses.positions), len(gaussians.means), *sizes)
    return calls.run(name, gaussians.means, *buffers, *inputs, sizes=counts, settings=settings)


@kernel("plan", "cpu")
def _plan(out: Any, gaussians: Gaussians, ids: Tensor | None, poses: Poses, settings: KernelSettings) -> Any:
    (buffers, *screen), means = out, gaussians.means
    tensors = (*contiguous((*gaussians, *poses, ids)), *buffers[:-1], *screen)
    sizes = (len(poses.positions), len(means))
    status = calls.run("plan", means, *tensors, sizes=sizes, settings=settings)
    validation.raise_for_status(status, Pose(*poses))
    entries = int(buffers.starts.numpy()[-1])  # torch's own element takes ten times as long
    check_memory(entries, 4)
    buffers = buffers._replace(entries=means.new_empty(entries, dtype=torch.int32))
    calls.run("entries", means, *buffers, sizes=sizes, settings=settings)
    return buffers, *screen


@kernel("composite", "cpu")
def _composite(out: Any, features: Tensor, means2d: Tensor, **view: Any) -> None:
    run_on_plan("composite", features, *out, sizes=features.shape[::2], **view)


@kernel("composite_backward", "cpu")
def _composite_backward(
    out: Any,
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    features: Tensor,
    **view: Any,
) -> None:
    samples, _, channels = features.shape
    shared = len(view["poses"].positions) == 1
    per_entry = _native.MOMENTS + (samples * channels if shared else channels)
    check_memory(len(view["buffers"].entries), features.element_size() * per_entry)
    grads, *rest = out
    tensors = (features, image, transmittance, grad_image, grad_transmittance, *grads, *rest)
    run_on_plan("composite_backward", *tensors, sizes=(samples, channels), **view)


@kernel("weights", "cpu")
def _weights(out: Any, **view: Any) -> None:
    run_on_plan("weights", *out, **view)


@kernel("weights_backward", "cpu")
def _weights_backward(out: Any, grad_seen: Tensor, grad_total: Tensor, **view: Any) -> None:
    entries = view["buffers"].entries
    check_memory(len(entries), out.means.element_size() * _native.MOMENTS)
    run_on_plan("weights_backward", grad_seen, grad_total, *out, **view)


def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Order (V,) of the visible Gaussians, and the weights alpha T as blocks of pixels; see frozen.h."""
    view = kernel_view(plan, gaussians)
    run, order = partial(run_on_plan, "freeze", **view), view["buffers"].order
    counts = torch.zeros(strips(plan.grid.height) + 1, dtype=torch.int64)
    lanes = run(counts, None, None)
    starts = counts.cumsum(0)
    size = int(starts[-1])
    check_memory(size, 8 + lanes * gaussians.means.element_size())
    heads, weights = torch.empty(size, 2, dtype=torch.int32), gaussians.means.new_empty(size, lanes)
    if size > 0:
        run(starts, heads, weights)
    return order[0, : int(view["buffers"].shown[0])].to(torch.int64), (starts, heads, weights)


def instruction_set() -> str:
    """Name of the kernels in use: baseline, avx2 or avx512."""
    return _native.instruction_set()

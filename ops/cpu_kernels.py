"""The rasterizer's operators on CPU tensors, by the C++ kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import calls, validation
from gsparc.ops.geometry import Gaussians
from gsparc.ops.operators import Buffers, Poses, check_memory, contiguous, kernel, layout
from gsparc.ops.settings import KernelSettings


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
    validation.raise_for_status(calls.run("plan", means, *tensors, sizes=sizes, settings=settings))
    entries = int(buffers.starts[-1])
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
    per_entry = layout().MOMENTS + (samples * channels if shared else channels)
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
    check_memory(len(entries), out.means.element_size() * layout().MOMENTS)
    run_on_plan("weights_backward", grad_seen, grad_total, *out, **view)

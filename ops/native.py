"""The `cpu` backend: the operators on CPU tensors by the C++ kernels, and frozen views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, calls, validation
from gsparc.ops.geometry import Gaussians, SphereGrid
from gsparc.ops.operators import (
    check_memory,
    composite,
    contiguous,
    count_strips,
    make_plan,
    mean_weights,
    register_kernel,
)
from gsparc.ops.results import Plan

__all__ = ["composite", "freeze", "instruction_set", "make_plan", "mean_weights", "render_frozen"]


def run_on_plan(
    name: str, plan: Plan, gaussians: Gaussians, *tensors: Tensor | None, sizes: Sequence[int] = ()
) -> int:
    """Call a kernel that begins with `ViewArgs` of csrc/layout.h, then `tensors`."""
    inputs = contiguous((*gaussians, plan.pose.position, plan.pose.rotation, *tensors))
    counts = (plan.num_poses, plan.num_gaussians, *sizes)
    return calls.launch(
        name, gaussians.means, *plan.buffers, *inputs, sizes=counts, settings=plan.settings
    )


@register_kernel("plan", "cpu")
def _plan(plan: Plan, gaussians: Gaussians, ids: Tensor | None) -> Plan:
    means, pose = gaussians.means, plan.pose
    call = partial(calls.launch, sizes=(plan.num_poses, len(means)), settings=plan.settings)
    inputs = contiguous((*gaussians, pose.position, pose.rotation, ids))
    # In two passes: how many entries there are is known when all footprints have been placed.
    status = call(
        "plan", means, *inputs, *plan.buffers[:-1], plan.means2d, plan.radii, plan.visible
    )
    validation.raise_for_status(status, pose)
    entries = int(plan.buffers.starts.numpy()[-1])  # torch's own element takes ten times as long
    check_memory(entries, 4)
    buffers = plan.buffers._replace(entries=means.new_empty(entries, dtype=torch.int32))
    call("entries", means, *buffers)
    return replace(plan, buffers=buffers)


@register_kernel("composite", "cpu")
def _composite(out: Any, plan: Plan, gaussians: Gaussians, features: Tensor) -> None:
    run_on_plan("composite", plan, gaussians, features, *out, sizes=features.shape[::2])


@register_kernel("composite_backward", "cpu")
def _composite_backward(
    out: Any,
    plan: Plan,
    gaussians: Gaussians,
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    features: Tensor,
) -> None:
    samples, _, channels = features.shape
    # With one pose an entry holds the slopes of all samples' features.
    per_entry = _native.MOMENTS + (samples * channels if plan.num_poses == 1 else channels)
    check_memory(len(plan.buffers.entries), features.element_size() * per_entry)
    grads, *rest = out
    tensors = (features, image, transmittance, grad_image, grad_transmittance, *grads, *rest)
    run_on_plan("composite_backward", plan, gaussians, *tensors, sizes=(samples, channels))


@register_kernel("weights", "cpu")
def _weights(out: Any, plan: Plan, gaussians: Gaussians) -> None:
    run_on_plan("weights", plan, gaussians, *out)


@register_kernel("weights_backward", "cpu")
def _weights_backward(out: Any, plan: Plan, gaussians: Gaussians, *slopes: Tensor) -> None:
    check_memory(len(plan.buffers.entries), out.means.element_size() * _native.MOMENTS)
    run_on_plan("weights_backward", plan, gaussians, *slopes, *out)


def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return the order (V,) of visible Gaussians, and weights alpha T as blocks of pixels;
    see frozen.h.
    """
    rows, grid, run = _native.STRIP_ROWS, plan.grid, partial(run_on_plan, "freeze", plan, gaussians)
    counts = torch.zeros(
        count_strips(grid.height) * grid.width + 1, dtype=torch.int64
    )  # a tile has a column at least
    # Counted first, filled afterwards: the rows of a sparse matrix have no size before.
    lanes = run(counts, None, None)
    starts = counts[: count_strips(grid.height) * -(-grid.width * rows // lanes) + 1].cumsum(0)
    size = int(starts[-1])
    check_memory(size, 4 + lanes * gaussians.means.element_size())
    ranks, weights = torch.empty(size, dtype=torch.int32), gaussians.means.new_empty(size, lanes)
    if size > 0:
        run(starts, ranks, weights)
    order = plan.buffers.order[0, : int(plan.buffers.shown[0])].to(torch.int64)
    return order, (starts, ranks, weights)


def render_frozen(
    grid: SphereGrid,
    buffers: tuple[Tensor, ...],
    features: Tensor,
    order: Tensor,
    visible_only: bool,
) -> Tensor:
    """Return images (B C, H, W) of features (B, N, C), or (`visible_only`) those in `order`,
    (B, V, C).

    Raises:
        ValueError: features that are not finite, or not as many as `order` speaks of.
    """
    samples, count, channels = features.shape
    image = features.new_empty(samples * channels, grid.height, grid.width)
    tensors = contiguous((features, None if visible_only else order))
    sizes = (samples, channels, grid.height, grid.width, len(order), count)
    status = calls.launch("thaw", features, *buffers, *tensors, image, sizes=sizes)
    if status >= 0:
        validation.seen_features(features, order, visible_only)  # says what is wrong
    return image


def instruction_set() -> str:
    """Return the name of the kernels in use: baseline, avx2 or avx512."""
    return _native.instruction_set()

"""The `cuda` backend: the operators on CUDA tensors by the CUDA kernels, and frozen views.

A plan's buffers have the shapes of the CPU's, with contents of their own: records, boxes and
entries go by Gaussian instead of by rank, the last of the strip starts is the number of entries,
and the entries hold the tiles' starts (P tiles + 1), then for each entry its Gaussian and its slot.

Inside a captured CUDA graph nothing may synchronise, so a plan has room for as many entries as
earlier plans of this size needed, plus headroom; if it needs more,
its images and gradients are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, calls, cuda_library, validation
from gsparc.ops.geometry import Gaussians, SphereGrid
from gsparc.ops.operators import (
    Buffers,
    check_memory,
    composite,
    contiguous,
    make_plan,
    mean_weights,
    register_kernel,
)
from gsparc.ops.results import Plan
from gsparc.ops.settings import KernelSettings

__all__ = ["composite", "freeze", "load", "make_plan", "mean_weights", "render_frozen"]

BYTES_PER_ENTRY = 36  # entries and what sorting them takes
MOST_PAIRS = 2**31  # of poses and Gaussians: the kernels count them in 32 bits

_capacities: dict[tuple, int] = {}


def load() -> None:
    """Build or find the kernels and let them serve CUDA tensors
    (cuda_library.LibraryUnavailable).
    """
    if "cuda" not in calls.libraries:
        calls.libraries["cuda"] = cuda_library.load()


def count_tiles(settings: KernelSettings) -> int:
    """Count the tiles of one pose's image."""
    return -(-settings.height // _native.TILE_HEIGHT) * -(-settings.width // _native.TILE_WIDTH)


def _capacity_with_headroom(entries: int) -> int:
    """Capacity of a captured plan where the largest plan so far had so many entries."""
    # A quarter more, since a captured graph cannot grow when Gaussians move.
    return entries + entries // 4 + 1024


def _is_capturing(tensor: Tensor) -> bool:
    return tensor.is_cuda and torch.cuda.is_current_stream_capturing()


@cache
def _sincos(device: torch.device, dtype: torch.dtype, settings: KernelSettings) -> Tensor:
    """Sines and cosines of the grid's rows and columns, kept for good:
    captured graphs hold their address.
    """
    library = calls.libraries[device.type]
    call = calls.make_call(torch.empty(0, dtype=dtype), settings=settings)
    numbers = torch.empty(library.run("tables", call), dtype=dtype)
    call.tensors[0] = numbers.data_ptr()
    library.run("tables", call)
    return numbers.to(device)


def entry_capacity(plan: Plan) -> int:
    """Return how many entries a plan has room for."""
    # Of `entries`: the tiles' starts first, then two numbers for each entry.
    return (plan.buffers.entries.numel() - plan.num_poses * count_tiles(plan.settings) - 1) // 2


def run_on_plan(
    name: str, plan: Plan, gaussians: Gaussians, *tensors: Tensor | None, sizes: Sequence[int] = ()
) -> None:
    """Call a kernel that reads a plan (`read_view`), Gaussians and poses, then `tensors`."""
    means, buffers = gaussians.means, plan.buffers
    entries, capacity = None, 0
    if buffers.entries.numel():
        entries, capacity = buffers.entries, entry_capacity(plan)
    view = (
        _sincos(means.device, means.dtype, plan.settings),
        *buffers[:5],
        buffers.starts[-1:],
        entries,
    )
    inputs = contiguous((*gaussians, plan.pose.position, plan.pose.rotation, *tensors))
    counts = (plan.num_poses, len(means), capacity, *sizes)
    calls.launch(name, means, *view, *inputs, sizes=counts, settings=plan.settings)


@register_kernel("plan", "cuda")
def _plan(plan: Plan, gaussians: Gaussians, ids: Tensor | None) -> Plan:
    means, count, n, buffers = gaussians.means, plan.num_poses, plan.num_gaussians, plan.buffers
    # Before anything is allocated: an overflow in 32 bits would write out of bounds.
    if count * n >= MOST_PAIRS:
        raise MemoryError(
            f"{count} poses of {n} Gaussians are too many for a plan: take fewer poses at a time"
        )
    starts = count * count_tiles(plan.settings) + 1
    if count * n == 0:
        zeros = [buffer.zero_() for buffer in buffers[:-1]]
        return replace(plan, buffers=Buffers._make([*zeros, buffers.entries.new_zeros(starts)]))
    # Status of the plan, and how many entries it needs.
    verdict = means.new_empty(2, dtype=torch.int64)
    run_on_plan("plan", plan, gaussians, ids, plan.means2d, plan.radii, plan.visible, verdict)
    key = (count, n, plan.settings)
    if _is_capturing(means):
        if key not in _capacities:
            raise RuntimeError(
                "plan once before capturing: a graph cannot ask how many entries are needed"
            )
        capacity = _capacity_with_headroom(_capacities[key])
    else:
        status, capacity = verdict.tolist()
        validation.raise_for_status(status, plan.pose)
        # For graphs captured later, which have room for the largest plan so far.
        _capacities[key] = max(capacity, _capacities.get(key, 0))
    check_memory(capacity, BYTES_PER_ENTRY)
    # Starts of the tiles, then a Gaussian and a slot for each entry.
    entries = means.new_empty(starts + 2 * capacity, dtype=torch.int32)
    plan = replace(plan, buffers=buffers._replace(entries=entries))
    run_on_plan("bin", plan, gaussians)
    return plan


def _stack_features(features: Tensor, poses: int) -> Tensor:
    """Features (B, N, C) as (P, N, K) with the K channels of a pose side by side."""
    # One pose is seen by all samples: their channels side by side share its weights.
    if poses != 1:
        return features.contiguous()
    samples, n, channels = features.shape
    return features.permute(1, 0, 2).reshape(1, n, samples * channels).contiguous()


def _zero_gradients(gradients: Gaussians) -> None:
    """Gradients where no kernel runs: of no Gaussians, or over no poses."""
    for gradient in gradients:
        gradient.zero_()


@register_kernel("composite", "cuda")
def _composite(out: Any, plan: Plan, gaussians: Gaussians, features: Tensor) -> None:
    rows = _stack_features(features, plan.num_poses)
    if plan.num_poses > 0:
        run_on_plan("composite", plan, gaussians, rows, *out, sizes=rows.shape[2:])


@register_kernel("composite_backward", "cuda")
def _composite_backward(
    out: Any,
    plan: Plan,
    gaussians: Gaussians,
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    features: Tensor,
) -> Any:
    samples, n, channels = features.shape
    rows = _stack_features(features, plan.num_poses)
    check_memory(entry_capacity(plan), features.element_size() * (_native.MOMENTS + rows.shape[2]))
    grads, _, grad_means2d = out
    grad_rows = torch.empty_like(rows)
    images = (image, transmittance, grad_image, grad_transmittance)
    if plan.num_poses * n > 0:
        tensors = (rows, *images, *grads, grad_rows, grad_means2d)
        run_on_plan("composite_backward", plan, gaussians, *tensors, sizes=rows.shape[2:])
    else:
        _zero_gradients(grads)
    if plan.num_poses == 1:
        grad_rows = grad_rows.reshape(n, samples, channels).permute(1, 0, 2).contiguous()
    return grads, grad_rows, grad_means2d


@register_kernel("weights", "cuda")
def _weights(out: Any, plan: Plan, gaussians: Gaussians) -> Any:
    # The kernel writes both sums side by side.
    sums = out[0].new_empty(*out[0].shape, 2)
    if sums.numel():
        run_on_plan("weights", plan, gaussians, sums, None, None)
    return sums[..., 0].clone(), sums[..., 1].clone()


@register_kernel("weights_backward", "cuda")
def _weights_backward(out: Any, plan: Plan, gaussians: Gaussians, *slopes: Tensor) -> None:
    check_memory(entry_capacity(plan), out.means.element_size() * (_native.MOMENTS + 1))
    if slopes[0].numel() > 0:
        run_on_plan("weights_backward", plan, gaussians, *slopes, *out, sizes=(1,))
    else:
        _zero_gradients(out)


def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return the order (V,) of visible Gaussians; tiles' starts and ends,
    entries' ranks and 32 weights.
    """
    means, buffers, capacity = gaussians.means, plan.buffers, entry_capacity(plan)
    pixels = _native.TILE_WIDTH * _native.TILE_HEIGHT
    # A frozen entry is a block of weights, one for each pixel of its tile.
    check_memory(capacity, pixels * means.element_size())
    blocks = means.new_zeros(capacity, pixels)
    starts = buffers.entries[: count_tiles(plan.settings) + 1].clone()
    ends = starts[:-1].clone()
    # The kernel moves each end to the first entry of its tile that no pixel sees.
    if len(means) > 0:
        run_on_plan("weights", plan, gaussians, None, blocks, ends)
    order = buffers.order[0, : int(buffers.shown[0])].to(torch.int64)
    rank_of = order.new_zeros(len(means))
    rank_of[order] = torch.arange(len(order), device=order.device)
    of_entries = buffers.entries[len(starts) : len(starts) + capacity].to(torch.int64)
    return order, (starts, ends, rank_of[of_entries].to(torch.int32), blocks)


def render_frozen(
    grid: SphereGrid,
    buffers: tuple[Tensor, ...],
    features: Tensor,
    order: Tensor,
    visible_only: bool,
) -> Tensor:
    """Return images (B C, H, W) of features (B, N, C), or (`visible_only`) those in `order`,
    (B, V, C).
    """
    columns = validation.seen_features(features, order, visible_only).contiguous()
    image = columns.new_empty(columns.shape[1], grid.height, grid.width)
    if image.numel():
        calls.launch("thaw", columns, *buffers, columns, image, sizes=image.shape)
    return image

"""The `cpu` backend: the operators on CPU tensors by the C++ kernels, and frozen views."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, calls, operators, validation
from gsparc.ops.geometry import Gaussians, Pose, SphereGrid
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
)
from gsparc.ops.plan import Plan
from gsparc.ops.settings import KernelSettings

__all__ = ["composite", "freeze", "instruction_set", "make_plan", "mean_weights", "rasterize", "thaw"]

NO_PLAN = (None,) * len(Buffers._fields)


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


def rasterize(
    gaussians: Gaussians, ids: Tensor | None, pose: Pose, features: Tensor, settings: KernelSettings
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What a `Raster` holds, in one call that keeps no plan and passes no gradient.

    Raises:
        ValueError, MemoryError: as `make_plan` and `composite`.
    """
    means, poses, n = gaussians.means, len(pose), len(gaussians.means)
    samples, _, channels = features.shape
    size = settings.height, settings.width
    image, transmittance = means.new_empty(samples, channels, *size), means.new_empty(poses, *size)
    means2d, radii = means.new_empty(poses, n, 2), means.new_empty(poses, n)
    visible = means.new_empty(poses, n, dtype=torch.bool)
    strongest = validation.strongest(gaussians).opacities
    inputs = contiguous((*gaussians, pose.position, pose.rotation, features))
    tensors = (*NO_PLAN, *inputs, image, transmittance, *contiguous((strongest, ids)))
    sizes, bound = (poses, n, samples, channels), (operators.MEMORY_BOUND,)
    screen = means2d, radii, visible
    status = calls.run("rasterize", means, *tensors, *screen, sizes=sizes, numbers=bound, settings=settings)
    if status <= _native.REFUSED:
        check_memory(_native.REFUSED - status, 4)
    if status == _native.UNSOUND_FEATURES:
        validation.check_features(features)
    validation.raise_for_status(status, pose)
    return image, transmittance, radii, visible, means2d


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
    view, rows, grid = kernel_view(plan, gaussians), _native.STRIP_ROWS, plan.grid
    run, order = partial(run_on_plan, "freeze", **view), view["buffers"].order
    counts = torch.zeros(
        strips(grid.height) * grid.width + 1, dtype=torch.int64
    )  # a tile has a column at least
    lanes = run(counts, None, None)
    starts = counts[: strips(grid.height) * -(-grid.width * rows // lanes) + 1].cumsum(0)
    size = int(starts[-1])
    check_memory(size, 4 + lanes * gaussians.means.element_size())
    ranks, weights = torch.empty(size, dtype=torch.int32), gaussians.means.new_empty(size, lanes)
    if size > 0:
        run(starts, ranks, weights)
    return order[0, : int(view["buffers"].shown[0])].to(torch.int64), (starts, ranks, weights)


def thaw(
    grid: SphereGrid, buffers: tuple[Tensor, ...], features: Tensor, order: Tensor, picked: bool
) -> Tensor:
    """Images (B C, H, W) of features (B, N, C), or (`picked`) of those in `order` alone, (B, V, C).

    Raises:
        ValueError: features that are not finite, or not as many as `order` speaks of.
    """
    samples, given, channels = features.shape
    image = features.new_empty(samples * channels, grid.height, grid.width)
    tensors = contiguous((features, None if picked else order))
    sizes = (samples, channels, grid.height, grid.width, len(order), given)
    status = calls.run("thaw", features, *buffers, *tensors, image, sizes=sizes)
    if status >= 0:
        validation.seen_features(features, order, picked)  # says what is wrong
    return image


def instruction_set() -> str:
    """Name of the kernels in use: baseline, avx2 or avx512."""
    return _native.instruction_set()

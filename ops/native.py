"""The `cpu` backend: the C++ kernels as torch operators with fakes and gradients.

Operators are named `gsparc::...` and carry everything as tensors and numbers, so that another device can
register its own kernel under the same name.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsparc.ops import _native, door
from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.plan import Plan
from gsparc.ops.settings import ALPHA_MAX, HORIZON_COSINE, Optics

MEMORY_BOUND = 8 * 2**30
"""Bytes that one call may need for entries and gradient slots [B]; more is refused before it is allocated."""


def _numbers(grid: SphereGrid, optics: Optics) -> tuple[list[int], list[float]]:
    """What the kernels' `Lens` is made of."""
    tangent = optics.projection == "tangent"
    flags = [grid.periodic, tangent, optics.compensate, optics.cutoff.relative]
    return [grid.height, grid.width, *map(int, flags)], [
        *(grid.first_elevation, grid.first_azimuth, grid.elevation_step, grid.azimuth_step),
        *(optics.low_pass, optics.near, optics.cutoff.alpha, optics.cutoff.transmittance),
        *(ALPHA_MAX, HORIZON_COSINE),
    ]


def _addresses(*tensors: Tensor | None) -> list[int]:
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


def _strips(height: int) -> int:
    return -(-height // _native.STRIP_ROWS)


def _plan_tensors(means: Tensor, poses: int, height: int) -> tuple[Tensor, ...]:
    n = means.shape[0]
    return (
        means.new_empty(poses, n, _native.RECORD),
        means.new_empty(poses, n, 4, dtype=torch.int32),
        means.new_empty(poses, n, dtype=torch.int32),
        means.new_empty(poses, dtype=torch.int32),
        means.new_empty(poses, n + 1, dtype=torch.int64),
        means.new_empty(poses * _strips(height) + 1, dtype=torch.int64),
        means.new_empty(poses, n, 2),
        means.new_empty(poses, n),
        means.new_empty(poses, n, dtype=torch.bool),
    )


@custom_op("gsparc::plan", mutates_args=(), device_types="cpu")
def plan_op(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    strongest: Tensor,
    ids: Tensor | None,
    positions: Tensor,
    rotations: Tensor,
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Records, boxes, order, shown, slots, strip starts, entries; means2d, radii, visible."""
    poses, n, twice, threads = (
        positions.shape[0],
        means.shape[0],
        means.dtype == torch.float64,
        torch.get_num_threads(),
    )
    *buffers, means2d, radii, visible = _plan_tensors(means, poses, whole[0])
    inputs = [t.contiguous() for t in (means, quats, scales, strongest)]
    outputs = (*buffers, means2d, radii, visible)
    wrong = _native.plan(
        *(twice, poses, n, threads, whole, real),
        _addresses(*inputs, None, positions.contiguous(), rotations.contiguous(), ids, *outputs),
    )
    if wrong >= 0:
        door.raise_for(("means", "quats", "scales", "opacities")[wrong % 4], wrong // 4)
    count = int(buffers[-1][-1])
    _check_memory(count, 4)
    entries = means.new_empty(count, dtype=torch.int32)
    _native.entries(twice, poses, n, threads, whole[0], _addresses(*buffers, entries))
    plan: Any = (*buffers, entries, means2d, radii, visible)
    return plan


@plan_op.register_fake
def _(means, quats, scales, strongest, ids, positions, rotations, whole, real):
    *buffers, means2d, radii, visible = _plan_tensors(means, positions.shape[0], whole[0])
    count = torch.library.get_ctx().new_dynamic_size()
    return (*buffers, means.new_empty(count, dtype=torch.int32), means2d, radii, visible)


@custom_op("gsparc::composite", mutates_args=(), device_types="cpu")
def composite_op(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    features: Tensor,
    means2d: Tensor,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """Image (B, C, H, W) and transmittance (P, H, W); `means2d` only receives a gradient."""
    samples, n, channels = features.shape
    image = features.new_empty(samples, channels, *whole[:2])
    transmittance = means.new_empty(positions.shape[0], *whole[:2])
    model = _model(means, quats, scales, opacities, extinctions, positions, rotations)
    features = features.contiguous()
    _native.composite(
        *(means.dtype == torch.float64, positions.shape[0], n, samples, channels, torch.get_num_threads()),
        *(whole, real, _addresses(*buffers, *model, features, image, transmittance)),
    )
    return image, transmittance


@composite_op.register_fake
def _(
    means,
    quats,
    scales,
    opacities,
    extinctions,
    features,
    means2d,
    positions,
    rotations,
    buffers,
    whole,
    real,
):
    image = features.new_empty(features.shape[0], features.shape[2], whole[0], whole[1])
    return image, means.new_empty(positions.shape[0], whole[0], whole[1])


@custom_op("gsparc::composite_backward", mutates_args=(), device_types="cpu")
def composite_backward_op(
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    features: Tensor,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means, quats, scales, opacities, extinctions (empty if absent), features, means2d."""
    samples, n, channels = features.shape
    poses = positions.shape[0]
    _check_memory(
        buffers[-1].shape[0],
        means.element_size() * (_native.MOMENTS + (samples * channels if poses == 1 else channels)),
    )
    model = _model(means, quats, scales, opacities, extinctions, positions, rotations)
    grads = _gradients(means, quats, scales, opacities, extinctions)
    grad_features, grad_screen = _like(features), means.new_empty(poses, n, 2)
    inputs = [t.contiguous() for t in (features, image, transmittance, grad_image)]
    grad_transmittance = None if grad_transmittance is None else grad_transmittance.contiguous()
    _native.composite_backward(
        *(means.dtype == torch.float64, poses, n, samples, channels, torch.get_num_threads(), whole, real),
        _addresses(*buffers, *model, *inputs, grad_transmittance, *grads, grad_features, grad_screen),
    )
    outputs: Any = (*_filled(grads, means), grad_features, grad_screen)
    return outputs


@composite_backward_op.register_fake
def _(
    grad_image,
    grad_transmittance,
    image,
    transmittance,
    means,
    quats,
    scales,
    opacities,
    extinctions,
    features,
    positions,
    rotations,
    buffers,
    whole,
    real,
):
    grads = _filled(_gradients(means, quats, scales, opacities, extinctions), means)
    return (*grads, _like(features), means.new_empty(positions.shape[0], means.shape[0], 2))


def _composite_setup(ctx, inputs, output):
    means, quats, scales, opacities, extinctions, features, _, positions, rotations, buffers, whole, real = (
        inputs
    )
    ctx.hides = extinctions is not None
    ctx.save_for_backward(
        *(*output, means, quats, scales, opacities, *([extinctions] if ctx.hides else [])),
        *(features, positions, rotations, *buffers),
    )
    ctx.whole, ctx.real = whole, real


def _composite_backward(ctx, grad_image, grad_transmittance):
    image, transmittance, means, quats, scales, opacities, *rest = ctx.saved_tensors
    extinctions = rest.pop(0) if ctx.hides else None
    features, positions, rotations, *buffers = rest
    if grad_image is None:
        grad_image = torch.zeros_like(image)
    *geometry, hidden, grad_features, grad_screen = composite_backward_op(
        *(grad_image, grad_transmittance, image, transmittance, means, quats, scales, opacities, extinctions),
        *(features, positions, rotations, buffers, ctx.whole, ctx.real),
    )
    return (
        *(*geometry, hidden if ctx.hides else None, grad_features, grad_screen),
        *(None, None, [None] * len(buffers), None, None),
    )


composite_op.register_autograd(_composite_backward, setup_context=_composite_setup)


@custom_op("gsparc::weights", mutates_args=(), device_types="cpu")
def weights_op(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """Sums over pixels of alpha T and of alpha, both (P, N)."""
    poses, n = positions.shape[0], means.shape[0]
    seen, total = means.new_empty(poses, n), means.new_empty(poses, n)
    model = _model(means, quats, scales, opacities, extinctions, positions, rotations)
    _native.weights(
        *(means.dtype == torch.float64, poses, n, torch.get_num_threads(), whole, real),
        _addresses(*buffers, *model, seen, total),
    )
    return seen, total


@weights_op.register_fake
def _(means, quats, scales, opacities, extinctions, positions, rotations, buffers, whole, real):
    size = (positions.shape[0], means.shape[0])
    return means.new_empty(size), means.new_empty(size)


@custom_op("gsparc::weights_backward", mutates_args=(), device_types="cpu")
def weights_backward_op(
    grad_seen: Tensor,
    grad_total: Tensor,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means, quats, scales, opacities, extinctions (empty if absent)."""
    poses, n = positions.shape[0], means.shape[0]
    _check_memory(buffers[-1].shape[0], means.element_size() * _native.MOMENTS)
    model = _model(means, quats, scales, opacities, extinctions, positions, rotations)
    grads = _gradients(means, quats, scales, opacities, extinctions)
    grad_seen, grad_total = grad_seen.contiguous(), grad_total.contiguous()
    _native.weights_backward(
        *(means.dtype == torch.float64, poses, n, torch.get_num_threads(), whole, real),
        _addresses(*buffers, *model, None, None, grad_seen, grad_total, *grads),
    )
    return _filled(grads, means)


@weights_backward_op.register_fake
def _(
    grad_seen,
    grad_total,
    means,
    quats,
    scales,
    opacities,
    extinctions,
    positions,
    rotations,
    buffers,
    whole,
    real,
):
    return _filled(_gradients(means, quats, scales, opacities, extinctions), means)


def _weights_setup(ctx, inputs, output):
    means, quats, scales, opacities, extinctions, positions, rotations, buffers, whole, real = inputs
    ctx.hides = extinctions is not None
    ctx.save_for_backward(
        *(means, quats, scales, opacities, *([extinctions] if ctx.hides else [])),
        *(positions, rotations, *buffers),
    )
    ctx.whole, ctx.real, ctx.size = whole, real, output[0].shape


def _weights_backward(ctx, grad_seen, grad_total):
    means, quats, scales, opacities, *rest = ctx.saved_tensors
    extinctions = rest.pop(0) if ctx.hides else None
    positions, rotations, *buffers = rest
    grads = [means.new_zeros(ctx.size) if g is None else g for g in (grad_seen, grad_total)]
    *geometry, hidden = weights_backward_op(
        *(
            *grads,
            means,
            quats,
            scales,
            opacities,
            extinctions,
            positions,
            rotations,
            buffers,
            ctx.whole,
            ctx.real,
        )
    )
    return *geometry, hidden if ctx.hides else None, None, None, [None] * len(buffers), None, None


weights_op.register_autograd(_weights_backward, setup_context=_weights_setup)


def make_plan(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    strongest: Tensor,
    ids: Tensor | None,
    pose: Pose,
    grid: SphereGrid,
    optics: Optics,
) -> Plan:
    """Project, cull, order and bin."""
    whole, real = _numbers(grid, optics)
    *buffers, means2d, radii, visible = plan_op(
        means, quats, scales, strongest, ids, pose.position, pose.rotation, whole, real
    )
    return Plan(pose, grid, optics, "cpu", means2d, radii, visible, tuple(buffers))


def composite(
    plan: Plan,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    features: Tensor,
    means2d: Tensor,
) -> tuple[Tensor, Tensor]:
    """Image (B, C, H, W) and transmittance (P, H, W) of features (B, N, C)."""
    return composite_op(
        *(means, quats, scales, opacities, extinctions, features, means2d),
        *(plan.pose.position, plan.pose.rotation, plan.buffers, *_numbers(plan.grid, plan.optics)),
    )


def mean_weights(
    plan: Plan, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, extinctions: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Mean over pixels of alpha T, and its share of alpha: both (P, N)."""
    seen, total = weights_op(
        *(means, quats, scales, opacities, extinctions, plan.pose.position, plan.pose.rotation),
        *(plan.buffers, *_numbers(plan.grid, plan.optics)),
    )
    share = torch.where(total > 0, seen / torch.where(total > 0, total, 1.0), 0.0)
    return seen / (plan.grid.height * plan.grid.width), share


def freeze(
    plan: Plan,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Order (V,) of the visible Gaussians, and the weights alpha T as blocks of pixels; see frozen.h."""
    whole, real = _numbers(plan.grid, plan.optics)
    model = _model(means, quats, scales, opacities, extinctions, plan.pose.position, plan.pose.rotation)
    head = (means.dtype == torch.float64, means.shape[0], torch.get_num_threads(), whole, real)
    counts = torch.zeros(_strips(plan.grid.height) + 1, dtype=torch.int64)
    lanes = _native.freeze(*head, _addresses(*plan.buffers, *model, counts, None, None))
    starts = counts.cumsum(0)
    size = int(starts[-1])
    _check_memory(size, 8 + lanes * means.element_size())
    heads, weights = torch.empty(size, 2, dtype=torch.int32), means.new_empty(size, lanes)
    if size > 0:
        _native.freeze(*head, _addresses(*plan.buffers, *model, starts, heads, weights))
    shown = int(plan.buffers[3][0])
    return plan.buffers[2][0, :shown].to(torch.int64), (starts, heads, weights)


def thaw(grid: SphereGrid, buffers: tuple[Tensor, ...], features: Tensor) -> Tensor:
    """Image (K, H, W) of features (V, K) in the order of `freeze`."""
    if features.dtype != buffers[2].dtype:
        raise TypeError(f"features are {features.dtype}, this view was frozen in {buffers[2].dtype}")
    features = features.contiguous()
    image = features.new_empty(features.shape[1], grid.height, grid.width)
    _native.thaw(
        *(
            features.dtype == torch.float64,
            grid.height,
            grid.width,
            features.shape[1],
            torch.get_num_threads(),
        ),
        _addresses(*buffers, features, image),
    )
    return image


def instruction_set() -> str:
    """Name of the kernels in use: baseline, avx2 or avx512."""
    return _native.instruction_set()


def _model(means, quats, scales, opacities, extinctions, positions, rotations) -> list[Tensor | None]:
    tensors = (means, quats, scales, opacities, extinctions, positions, rotations)
    return [None if tensor is None else tensor.detach().contiguous() for tensor in tensors]


def _like(tensor: Tensor) -> Tensor:
    return tensor.new_empty(tensor.shape)


def _gradients(means, quats, scales, opacities, extinctions) -> list[Tensor | None]:
    tensors = (means, quats, scales, opacities, extinctions)
    return [None if tensor is None else _like(tensor) for tensor in tensors]


def _filled(grads: list[Tensor | None], means: Tensor) -> Any:
    return tuple(means.new_empty(0) if grad is None else grad for grad in grads)


def _check_memory(entries: int, bytes_each: int) -> None:
    if entries * bytes_each > MEMORY_BOUND:
        raise MemoryError(
            f"{entries} footprint entries need {entries * bytes_each / 2**30:.1f} GiB, the bound is "
            f"{MEMORY_BOUND / 2**30:.0f} GiB: use fewer or smaller Gaussians, or fewer poses at a time"
        )

"""The rasterizer's operators, defined once for every device: names, shapes and gradients.

Operators are named `gsparc::...` and carry everything as tensors and numbers. What computes them on a device
is a module with a function of each operator's name, entered in `KERNELS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsparc.ops import built
from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.plan import Plan
from gsparc.ops.results import visible_share
from gsparc.ops.settings import ALPHA_MAX, HORIZON_COSINE, Optics

KERNELS: dict[str, ModuleType] = {}
"""By type of device; backends enter theirs when they are loaded."""

MEMORY_BOUND = 8 * 2**30
"""Bytes that one call may need for entries and gradient slots [B]; more is refused before it is allocated."""


def layout() -> Any:
    """Constants that the kernels of all devices share: RECORD, MOMENTS, STRIP_ROWS, UNSOUND_POSE."""
    return built.kernels()


def numbers(grid: SphereGrid, optics: Optics) -> tuple[list[int], list[float]]:
    """What the kernels' `Lens` is made of."""
    tangent = optics.projection == "tangent"
    flags = [grid.periodic, tangent, optics.compensate, optics.cutoff.relative]
    return [grid.height, grid.width, *map(int, flags)], [
        *(grid.first_elevation, grid.first_azimuth, grid.elevation_step, grid.azimuth_step),
        *(optics.low_pass, optics.near, optics.cutoff.alpha, optics.cutoff.transmittance),
        *(ALPHA_MAX, HORIZON_COSINE),
    ]


def strips(height: int) -> int:
    """Strips of an image so many rows high."""
    return -(-height // layout().STRIP_ROWS)


def plan_tensors(means: Tensor, poses: int, height: int) -> tuple[Tensor, ...]:
    """A plan's buffers before its entries, then means2d, radii and visible."""
    n = means.shape[0]
    return (
        means.new_empty(poses, n, layout().RECORD),
        means.new_empty(poses, n, 4, dtype=torch.int32),
        means.new_empty(poses, n, dtype=torch.int32),
        means.new_empty(poses, dtype=torch.int32),
        means.new_empty(poses, n + 1, dtype=torch.int64),
        means.new_empty(poses * strips(height) + 1, dtype=torch.int64),
        means.new_empty(poses, n, 2),
        means.new_empty(poses, n),
        means.new_empty(poses, n, dtype=torch.bool),
    )


@custom_op("gsparc::plan", mutates_args=())
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
    return KERNELS[means.device.type].plan(
        means, quats, scales, strongest, ids, positions, rotations, whole, real
    )


@plan_op.register_fake
def _(means, quats, scales, strongest, ids, positions, rotations, whole, real):
    *buffers, means2d, radii, visible = plan_tensors(means, positions.shape[0], whole[0])
    count = torch.library.get_ctx().new_dynamic_size()
    return (*buffers, means.new_empty(count, dtype=torch.int32), means2d, radii, visible)


@custom_op("gsparc::composite", mutates_args=())
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
    return KERNELS[means.device.type].composite(
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
    )


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


@custom_op("gsparc::composite_backward", mutates_args=())
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
    return KERNELS[grad_image.device.type].composite_backward(
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
    )


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
    grads = filled(gradients(means, quats, scales, opacities, extinctions), means)
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


@custom_op("gsparc::weights", mutates_args=())
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
    return KERNELS[means.device.type].weights(
        means, quats, scales, opacities, extinctions, positions, rotations, buffers, whole, real
    )


@weights_op.register_fake
def _(means, quats, scales, opacities, extinctions, positions, rotations, buffers, whole, real):
    size = (positions.shape[0], means.shape[0])
    return means.new_empty(size), means.new_empty(size)


@custom_op("gsparc::weights_backward", mutates_args=())
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
    return KERNELS[grad_seen.device.type].weights_backward(
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
    )


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
    return filled(gradients(means, quats, scales, opacities, extinctions), means)


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
    whole, real = numbers(grid, optics)
    *buffers, means2d, radii, visible = plan_op(
        means, quats, scales, strongest, ids, pose.position, pose.rotation, whole, real
    )
    return Plan(pose, grid, optics, means.device.type, means2d, radii, visible, tuple(buffers))


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
        *(plan.pose.position, plan.pose.rotation, plan.buffers, *numbers(plan.grid, plan.optics)),
    )


def mean_weights(
    plan: Plan, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, extinctions: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Mean over pixels of alpha T, and its share of alpha: both (P, N)."""
    seen, total = weights_op(
        *(means, quats, scales, opacities, extinctions, plan.pose.position, plan.pose.rotation),
        *(plan.buffers, *numbers(plan.grid, plan.optics)),
    )
    return seen / (plan.grid.height * plan.grid.width), visible_share(seen, total)


def model_of(means, quats, scales, opacities, extinctions, positions, rotations) -> list[Tensor | None]:
    """What kernels read as a model: detached and contiguous."""
    tensors = (means, quats, scales, opacities, extinctions, positions, rotations)
    return [None if tensor is None else tensor.detach().contiguous() for tensor in tensors]


def _like(tensor: Tensor) -> Tensor:
    return tensor.new_empty(tensor.shape)


def gradients(means, quats, scales, opacities, extinctions) -> list[Tensor | None]:
    """Room for a model's gradients, None where there is no tensor."""
    tensors = (means, quats, scales, opacities, extinctions)
    return [None if tensor is None else _like(tensor) for tensor in tensors]


def filled(grads: list[Tensor | None], means: Tensor) -> Any:
    """As an operator returns them: an empty tensor in the place of None."""
    return tuple(means.new_empty(0) if grad is None else grad for grad in grads)


def check_memory(entries: int, bytes_each: int) -> None:
    """MemoryError, in one line, where entries would need more than `MEMORY_BOUND`."""
    if entries * bytes_each > MEMORY_BOUND:
        raise MemoryError(
            f"{entries} footprint entries need {entries * bytes_each / 2**30:.1f} GiB, the bound is "
            f"{MEMORY_BOUND / 2**30:.0f} GiB: use fewer or smaller Gaussians, or fewer poses at a time"
        )

"""What kernels compute on a plan: shapes and gradients stated once, filled on each device.

An operator makes its empty outputs and has them filled by the function that `kernel` marks for its
name and the device; `call_differentiable` joins it with its gradient, another operator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.geometry import Gaussians, Pose, SphereGrid
from gsparc.ops.results import Plan, Weights, visible_share
from gsparc.ops.settings import Optics

KERNELS: dict[str, dict[str, Callable[..., Any]]] = {"cpu": {}, "cuda": {}}
"""What computes an operator, by type of device and name; see `kernel`."""

MEMORY_BOUND = 8 * 2**30
"""Bytes that one call may need for entries and gradient slots [B];
more is refused before it is allocated.
"""


class Buffers(NamedTuple):
    """A plan as the CPU kernels lay it out (cuda.py says what differs there).

    Attributes:
        records: (P, N, RECORD) footprints, by depth.
        boxes: (P, N, 4) int32 rows and columns that each touches, by depth.
        order: (P, N) int32, Gaussian of each rank in depth.
        shown: (P,) int32, number of visible ranks.
        slots: (P, N + 1) int64, first entry of each rank.
        starts: (P strips + 1) int64, first entry of each strip of rows.
        entries: (E,) int32 ranks, front to back within each strip.
    """

    records: Tensor
    boxes: Tensor
    order: Tensor
    shown: Tensor
    slots: Tensor
    starts: Tensor
    entries: Tensor


_Function = TypeVar("_Function", bound=Callable[..., Any])


def register_kernel(name: str, device: str) -> Callable[[_Function], _Function]:
    """Mark what computes operator `name` on a type of device.

    It receives the operator's empty outputs, then its arguments, from `run_kernel`. It fills the
    outputs, or returns others in their place.
    """

    def mark(function: _Function) -> _Function:
        KERNELS[device][name] = function
        return function

    return mark


def run_kernel(name: str, like: Tensor, out: Any, *values: Any) -> Any:
    """Fill the empty outputs `out` of operator `name` on the device of `like`,
    given its arguments.
    """
    if like.is_meta:
        return out  # shapes alone
    result = KERNELS[like.device.type][name](out, *values)
    return out if result is None else result


class _Gradient(torch.autograd.Function):
    """A gradient by kernels, which has none of its own."""

    @staticmethod
    def forward(ctx, gradient, fixed, *tensors):
        return gradient(fixed, *tensors)

    @staticmethod
    def backward(ctx, *slopes):
        raise RuntimeError(
            "kernels have no second derivatives: take backend='reference', or torch.func.hessian"
        )


class _Operator(torch.autograd.Function):
    @staticmethod
    def forward(ctx, operator, gradient, reads_outputs, fixed, *tensors):
        outputs = operator(fixed, *tensors)
        ctx.gradient, ctx.fixed = gradient, fixed
        # An output that nothing depends on has the slope None instead of an image of zeros.
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*(outputs if reads_outputs else ()), *tensors)
        return outputs

    @staticmethod
    def backward(ctx, *slopes):
        # Nothing depends on any output: no kernel has to run.
        if all(slope is None for slope in slopes):
            return (None,) * len(ctx.needs_input_grad)
        gradients = _Gradient.apply(ctx.gradient, ctx.fixed, *slopes, *ctx.saved_tensors)
        return None, None, None, None, *gradients


def call_differentiable(
    operator: Callable[..., Any],
    gradient: Callable[..., Any],
    fixed: Any,
    *tensors: Tensor,
    reads_outputs: bool = False,
) -> Any:
    """Call `operator(fixed, *tensors)`; `gradient(fixed, *slopes, *tensors)` is its derivative.

    A slope is None where nothing depends on that output; at least one is given. Where the gradient
    reads the outputs they stand behind the slopes, and nobody may write into them.
    """
    if torch.is_grad_enabled():
        return _Operator.apply(operator, gradient, reads_outputs, fixed, *tensors)
    return operator(fixed, *tensors)


def count_strips(height: int) -> int:
    """Count the strips of an image so many rows high."""
    # Rounded up: the last strip may be cut off.
    return -(-height // calls.kernels().STRIP_ROWS)


def empty_like(tensors: Any) -> Any:
    """Return the named tuple of contiguous empty tensors shaped as those of `tensors`."""
    return type(tensors)(*(t.new_empty(t.shape) for t in tensors))


def contiguous(tensors: Iterable[Tensor | None]) -> list[Tensor | None]:
    """Return contiguous tensors, as kernels read them."""
    return [t if t is None or t.is_contiguous() else t.detach().contiguous() for t in tensors]


def make_plan(
    gaussians: Gaussians, ids: Tensor | None, pose: Pose, grid: SphereGrid, optics: Optics
) -> Plan:
    """Project, cull, order and bin."""
    means, poses, n = gaussians.means, len(pose), len(gaussians.means)
    buffers = Buffers(
        records=means.new_empty(poses, n, calls.kernels().RECORD),
        boxes=means.new_empty(poses, n, 4, dtype=torch.int32),
        order=means.new_empty(poses, n, dtype=torch.int32),
        shown=means.new_empty(poses, dtype=torch.int32),
        slots=means.new_empty(poses, n + 1, dtype=torch.int64),
        starts=means.new_empty(poses * count_strips(grid.height) + 1, dtype=torch.int64),
        entries=means.new_empty(0, dtype=torch.int32),  # the kernel counts them
    )
    empty = Plan(
        *(pose, grid, optics, means.device.type),
        means2d=means.new_empty(poses, n, 2),
        radii=means.new_empty(poses, n),
        visible=means.new_empty(poses, n, dtype=torch.bool),
        buffers=buffers,
    )
    return run_kernel("plan", means, empty, gaussians, ids)


def _composite(
    plan: Plan, means2d: Tensor, features: Tensor, *parts: Tensor
) -> tuple[Tensor, Tensor]:
    samples, _, channels = features.shape
    size = plan.grid.height, plan.grid.width
    out = features.new_empty(samples, channels, *size), features.new_empty(plan.num_poses, *size)
    return run_kernel("composite", features, out, plan, Gaussians(*parts), features)


def composite_gradient(
    plan: Plan,
    grad_image: Tensor | None,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    means2d: Tensor,
    features: Tensor,
    *parts: Tensor,
) -> tuple[Tensor | None, ...]:
    """Return gradients of means2d, features and `parts`, given those of image and transmittance."""
    # Kernels always read a slope of the image, one of the transmittance where there is one.
    gaussians, slope = (
        Gaussians(*parts),
        torch.zeros_like(image) if grad_image is None else grad_image,
    )
    out = (
        empty_like(gaussians),
        features.new_empty(features.shape),
        means2d.new_empty(means2d.shape),
    )
    values = slope, grad_transmittance, image, transmittance, features
    grads, grad_features, grad_means2d = run_kernel(
        "composite_backward", image, out, plan, gaussians, *values
    )
    return grad_means2d, grad_features, *grads


def composite(
    plan: Plan, gaussians: Gaussians, features: Tensor, means2d: Tensor
) -> tuple[Tensor, Tensor]:
    """Return image (B, C, H, W), transmittance (P, H, W) of (B, N, C);
    `means2d` only gets a gradient.
    """
    inputs = means2d, features, *gaussians
    return call_differentiable(_composite, composite_gradient, plan, *inputs, reads_outputs=True)


def _weights(plan: Plan, *parts: Tensor) -> tuple[Tensor, Tensor]:
    gaussians, size = Gaussians(*parts), (plan.num_poses, plan.num_gaussians)
    out = gaussians.means.new_empty(size), gaussians.means.new_empty(size)
    return run_kernel("weights", gaussians.means, out, plan, gaussians)


def _weights_gradient(
    plan: Plan, grad_seen: Tensor | None, grad_total: Tensor | None, *parts: Tensor
) -> Gaussians:
    gaussians, size = Gaussians(*parts), (plan.num_poses, plan.num_gaussians)
    # The kernel reads both slopes: one that nothing depends on is 0.
    slopes = [gaussians.means.new_zeros(size) if s is None else s for s in (grad_seen, grad_total)]
    return run_kernel(
        "weights_backward", gaussians.means, empty_like(gaussians), plan, gaussians, *slopes
    )


def mean_weights(plan: Plan, gaussians: Gaussians) -> Weights:
    """Return the mean over pixels of alpha T, and its share of alpha: both (P, N)."""
    seen, total = call_differentiable(_weights, _weights_gradient, plan, *gaussians)
    return Weights(seen / (plan.grid.height * plan.grid.width), visible_share(seen, total))


def check_memory(entries: int, bytes_each: int) -> None:
    """Raise MemoryError, in one line, where entries would need more than `MEMORY_BOUND`."""
    if entries * bytes_each > MEMORY_BOUND:
        raise MemoryError(
            f"{entries} footprint entries need {entries * bytes_each / 2**30:.1f} GiB, the bound "
            "is "
            f"{MEMORY_BOUND / 2**30:.0f} GiB: use fewer or smaller Gaussians, or fewer poses at "
            "a time"
        )

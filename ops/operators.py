"""The rasterizer's operators `gsparc::...`, each signature stated once: names, shapes and gradients.

An operator is a function that returns empty tensors of the right shapes, which is also its fake. What fills
them on a device is a function marked with `kernel`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar, get_type_hints

import torch
from torch import Tensor
from torch.library import CustomOpDef, custom_op

from gsparc.ops import built
from gsparc.ops.geometry import Gaussians, Pose, SphereGrid
from gsparc.ops.plan import Plan
from gsparc.ops.results import visible_share
from gsparc.ops.settings import KernelSettings, Optics, kernel_settings
from gsparc.ops.transforms import carries_tangent, unwatched

KERNELS: dict[str, dict[str, Callable[..., Any]]] = {"cpu": {}, "cuda": {}}
"""What computes an operator, by type of device and name; see `kernel`."""

MEMORY_BOUND = 8 * 2**30
"""Bytes that one call may need for entries and gradient slots [B]; more is refused before it is allocated."""


class Poses(NamedTuple):
    """P receiver poses: positions (P, 3) [m] and local-to-world rotations (P, 3, 3)."""

    positions: Tensor
    rotations: Tensor


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


def _leaves(values: Iterable[Any]) -> list[Any]:
    """Values with the fields of named tuples in their places."""
    return [leaf for value in values for leaf in (value if isinstance(value, tuple) else (value,))]


def _outputs(outputs: Any, like: Tensor) -> Any:
    """As an operator returns them: flat, with an empty tensor in the place of None."""
    if isinstance(outputs, Tensor):
        return outputs
    return tuple(like.new_empty(0) if leaf is None else leaf for leaf in _leaves(outputs))


_KINDS = tuple(get_type_hints(KernelSettings).values())


def packed(settings: KernelSettings) -> list[float]:
    """Settings as an operator takes them."""
    return list(map(float, settings))


@lru_cache(maxsize=64)
def _named(numbers: tuple[float, ...]) -> KernelSettings:
    return KernelSettings(*(kind(number) for kind, number in zip(_KINDS, numbers, strict=True)))


def _unpacked(packed: tuple[Sequence[float]]) -> KernelSettings:
    return _named(tuple(packed[0]))


class Operator:
    """An operator of torch that refuses what it would answer with zeros in silence.

    Attributes:
        defined: the operator as torch knows it.
        fill: what computes it in the end, of arguments in their named tuples.
    """

    def __init__(self, defined: CustomOpDef, fill: Callable[..., Any]) -> None:
        self.defined, self.fill = defined, fill
        self.register_autograd = defined.register_autograd

    def of(self, *values: Any) -> Any:
        """Call it with arguments in their named tuples, past torch's dispatcher where it only passes on."""
        leaves = _leaves(value for value in values if type(value) is not KernelSettings)
        if unwatched(leaves):
            return self.fill(*values)
        return self(*_leaves(packed(value) if type(value) is KernelSettings else value for value in values))

    def __call__(self, *flat: Any) -> Any:
        """Call it (RuntimeError for tangents of forward mode, which a kernel does not see)."""
        if carries_tangent(*flat):
            raise RuntimeError(
                f"{self.defined._qualname} has no forward-mode derivative; take backend='reference'"
            )
        return self.defined(*flat)


def _no_second_derivative(ctx, *slopes):
    raise RuntimeError("kernels have no second derivatives: take backend='reference', or torch.func.hessian")


def operator(shapes: Callable[..., Any]) -> Operator:
    """Define `gsparc::NAME` of a function `NAME_op`.

    Each field of a named tuple becomes an argument; `KernelSettings` become one list of numbers (`packed`),
    for torch's time per call grows with the square of the number of arguments.

    The first argument of every operator is a tensor, whose device selects the kernel.
    """
    name = shapes.__name__.removesuffix("_op")
    hints = get_type_hints(shapes)
    returned = hints.pop("return")
    arguments: dict[str, Any] = {}
    groups: list[tuple[Any, int, int]] = []  # named tuple or None, first and last argument
    for parameter, hint in hints.items():
        make, fields = getattr(hint, "_make", None), {parameter: hint}
        if hint is KernelSettings:
            make, fields = _unpacked, {parameter: Sequence[float]}
        elif make:
            fields = get_type_hints(hint)
        groups.append((make, len(arguments), len(arguments) + len(fields)))
        arguments |= fields

    def grouped(flat: tuple[Any, ...]) -> list[Any]:
        return [make(flat[first:last]) if make else flat[first] for make, first, last in groups]

    def fill(*values: Any) -> Any:
        out, first = shapes(*values), _leaves(values[:1])[0]
        own = KERNELS[first.device.type][name](out, **dict(zip(hints, values, strict=True)))
        return _outputs(out if own is None else own, first)

    def compute(*flat: Any) -> Any:
        return fill(*grouped(flat))

    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [inspect.Parameter(key, kind, annotation=hint) for key, hint in arguments.items()]
    if returned is not Tensor:
        parts = (returned,) if hasattr(returned, "_fields") else returned.__args__
        count = sum(len(getattr(part, "_fields", (0,))) for part in parts)
        returned = tuple[(Tensor,) * count]  # type: ignore[misc]
    compute.__signature__ = inspect.Signature(parameters, return_annotation=returned)  # type: ignore[attr-defined]
    compute.__doc__ = shapes.__doc__
    defined = custom_op(f"gsparc::{name}", compute, mutates_args=())
    defined.register_fake(lambda *flat: _outputs(shapes(*grouped(flat)), flat[0]))
    if name.endswith("_backward"):
        defined.register_autograd(_no_second_derivative)
    return Operator(defined, fill)


_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(name: str, *devices: str) -> Callable[[_Function], _Function]:
    """Mark what computes operator `name` on types of device.

    It receives the operator's empty outputs, then the operator's arguments by name. It fills the outputs, or
    returns others in their place.
    """

    def mark(function: _Function) -> _Function:
        for device in devices:
            KERNELS[device][name] = function
        return function

    return mark


def strips(height: int) -> int:
    """Strips of an image so many rows high."""
    return -(-height // built.kernels().STRIP_ROWS)


def empty_like(tensors: Any) -> Any:
    """The named tuple of contiguous empty tensors shaped as those of `tensors`, None where there is none."""
    return type(tensors)(*(None if t is None else t.new_empty(t.shape) for t in tensors))


def contiguous(tensors: Iterable[Tensor | None]) -> list[Tensor | None]:
    """Contiguous tensors, as kernels read them."""
    return [t if t is None or t.is_contiguous() else t.detach().contiguous() for t in tensors]


def plan_tensors(
    means: Tensor, poses: int, height: int, entries: int | torch.SymInt
) -> tuple[Buffers, Tensor, Tensor, Tensor]:
    """Empty tensors of a plan as the CPU lays it out, then of means2d, radii and visible."""
    n = means.shape[0]
    buffers = Buffers(
        records=means.new_empty(poses, n, built.kernels().RECORD),
        boxes=means.new_empty(poses, n, 4, dtype=torch.int32),
        order=means.new_empty(poses, n, dtype=torch.int32),
        shown=means.new_empty(poses, dtype=torch.int32),
        slots=means.new_empty(poses, n + 1, dtype=torch.int64),
        starts=means.new_empty(poses * strips(height) + 1, dtype=torch.int64),
        entries=means.new_empty(entries, dtype=torch.int32),
    )
    screen = means.new_empty(poses, n, 2), means.new_empty(poses, n)
    return buffers, *screen, means.new_empty(poses, n, dtype=torch.bool)


@operator
def plan_op(
    gaussians: Gaussians, ids: Tensor | None, poses: Poses, settings: KernelSettings
) -> tuple[Buffers, Tensor, Tensor, Tensor]:
    """Plan, means2d (P, N, 2), radii and visible (P, N); opacities: the larger of opacity and extinction."""
    tracing = torch.library.get_ctx()  # otherwise the kernel will know
    count = tracing.new_dynamic_size() if tracing else 0
    return plan_tensors(gaussians.means, poses.positions.shape[0], settings.height, count)


@operator
def composite_op(
    means2d: Tensor,
    gaussians: Gaussians,
    features: Tensor,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> tuple[Tensor, Tensor]:
    """Image (B, C, H, W) and transmittance (P, H, W); `means2d` only receives a gradient."""
    size = (settings.height, settings.width)
    image = features.new_empty(features.shape[0], features.shape[2], *size)
    return image, means2d.new_empty(means2d.shape[0], *size)


@operator
def composite_backward_op(
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    gaussians: Gaussians,
    features: Tensor,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> tuple[Gaussians, Tensor, Tensor]:
    """Gradients of the Gaussians (extinctions empty if absent), features and means2d."""
    screen = image.new_empty(poses.positions.shape[0], gaussians.means.shape[0], 2)
    return empty_like(gaussians), features.new_empty(features.shape), screen


@operator
def weights_op(
    gaussians: Gaussians, poses: Poses, buffers: Buffers, settings: KernelSettings
) -> tuple[Tensor, Tensor]:
    """Sums over pixels of alpha T and of alpha, both (P, N)."""
    size = (poses.positions.shape[0], gaussians.means.shape[0])
    return gaussians.means.new_empty(size), gaussians.means.new_empty(size)


@operator
def weights_backward_op(
    grad_seen: Tensor,
    grad_total: Tensor,
    gaussians: Gaussians,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> Gaussians:
    """Gradients of the Gaussians (extinctions empty if absent)."""
    return empty_like(gaussians)


def _gradients(gaussians: tuple[Tensor, ...], tensors: list[Tensor | None]) -> list[Tensor | None]:
    """Gradients of the Gaussians, which are the first `tensors`: None for an absent one."""
    return [g if t is not None else None for g, t in zip(gaussians, tensors, strict=False)]


def _composite_setup(ctx, inputs, output):
    ctx.save_for_backward(*output, *inputs[1:-1])
    ctx.settings = inputs[-1]


def _composite_backward(ctx, grad_image, grad_transmittance):
    image, transmittance, *tensors = ctx.saved_tensors
    if grad_image is None:
        grad_image = torch.zeros_like(image)
    *gaussians, features, means2d = composite_backward_op(
        grad_image, grad_transmittance, image, transmittance, *tensors, ctx.settings
    )
    rest = [None] * (len(tensors) - 5)
    return means2d, *_gradients(gaussians, tensors), features, *rest


composite_op.register_autograd(_composite_backward, setup_context=_composite_setup)


def _weights_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:-1])
    ctx.settings, ctx.size = inputs[-1], output[0].shape


def _weights_backward(ctx, *grads):
    tensors = ctx.saved_tensors
    filled = [tensors[0].new_zeros(ctx.size) if grad is None else grad for grad in grads]
    gaussians = weights_backward_op(*filled, *tensors, ctx.settings)
    return *_gradients(gaussians, tensors), *[None] * (len(tensors) - 4)


weights_op.register_autograd(_weights_backward, setup_context=_weights_setup)


def make_plan(gaussians: Gaussians, ids: Tensor | None, pose: Pose, grid: SphereGrid, optics: Optics) -> Plan:
    """Project, cull, order and bin."""
    poses = Poses(pose.position, pose.rotation)
    *buffers, means2d, radii, visible = plan_op.of(gaussians, ids, poses, kernel_settings(grid, optics))
    device = gaussians.means.device.type
    return Plan(pose, grid, optics, device, means2d, radii, visible, Buffers(*buffers))


def view_of(plan: Plan) -> tuple[Any, ...]:
    """The last arguments of an operator on a plan."""
    settings = kernel_settings(plan.grid, plan.optics)
    return Poses(plan.pose.position, plan.pose.rotation), Buffers(*plan.buffers), settings


def kernel_view(plan: Plan, gaussians: Gaussians) -> dict[str, Any]:
    """A plan as kernels receive it (`kernel`): buffers, gaussians, poses and settings."""
    poses, buffers, settings = view_of(plan)
    return {"buffers": buffers, "gaussians": gaussians, "poses": poses, "settings": settings}


def composite(plan: Plan, gaussians: Gaussians, features: Tensor, means2d: Tensor) -> tuple[Tensor, Tensor]:
    """Image (B, C, H, W) and transmittance (P, H, W) of features (B, N, C)."""
    return composite_op.of(means2d, gaussians, features, *view_of(plan))


def mean_weights(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Mean over pixels of alpha T, and its share of alpha: both (P, N)."""
    seen, total = weights_op.of(gaussians, *view_of(plan))
    return seen / (plan.grid.height * plan.grid.width), visible_share(seen, total)


def check_memory(entries: int, bytes_each: int) -> None:
    """MemoryError, in one line, where entries would need more than `MEMORY_BOUND`."""
    if entries * bytes_each > MEMORY_BOUND:
        raise MemoryError(
            f"{entries} footprint entries need {entries * bytes_each / 2**30:.1f} GiB, the bound is "
            f"{MEMORY_BOUND / 2**30:.0f} GiB: use fewer or smaller Gaussians, or fewer poses at a time"
        )

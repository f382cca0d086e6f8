"""Input validation of the rasterizer: each error is one line that says what to change."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.geometry import Gaussians, Pose
from gsparc.ops.settings import FARTHEST, SKEW, WIDEST
from gsparc.ops.transforms import (
    carries_tangent,
    forward_mode_is_active,
    full_precision,
    has_vmap_axis,
    transform_is_active,
    unwrap,
)


class UnsoundGaussian(ValueError):
    """A Gaussian with a parameter out of range or not finite.

    Attributes:
        index: its row in the tensors.
    """

    def __init__(self, message: str, index: int) -> None:
        super().__init__(message)
        self.index = index


def check_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    ids: Tensor | None,
) -> Gaussians:
    """Return Gaussians whose shapes, dtypes and devices agree (ValueError, TypeError)."""
    # A tensor without axes has no length; its shape is refused below.
    n = means.shape[0] if means.dim() else 0
    result = Gaussians(means, quats, scales, opacities)
    expected = ((n, 3), (n, 4), (n, 3), (n,))
    for name, tensor, shape in zip(Gaussians._fields, result, expected, strict=True):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must be {shape} for {n} means, got {tuple(tensor.shape)}")
        _check_dtype_and_device(name, tensor, means)
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"the rasterizer computes in float32 or float64, got means in {means.dtype}"
        )
    if ids is not None and (
        tuple(ids.shape) != (n,) or ids.dtype != torch.int64 or ids.device != means.device
    ):
        raise ValueError(
            f"ids must be ({n},) int64 on {means.device}, got {tuple(ids.shape)} {ids.dtype}"
        )
    return result


def check_transforms(gaussians: Gaussians, pose: Pose, pose_trained: bool) -> None:
    """Refuse a pose whose gradient is asked for, which would be none,
    and Gaussians under `torch.vmap`.
    """
    if not pose_trained and not transform_is_active() and not forward_mode_is_active():
        return
    ends = (pose.position, pose.rotation)
    if (pose_trained and torch.is_grad_enabled()) or carries_tangent(*ends):
        raise ValueError("a pose has no gradients here: detach it, or move the Gaussians instead")
    if has_vmap_axis(*gaussians, *ends):
        raise ValueError(
            "torch.vmap over Gaussians or poses is not possible: give P poses, or features (B, "
            "N, C)"
        )


def check_finite(gaussians: Gaussians, pose: Pose) -> None:
    """Check that parameters and poses are finite and
    in range (ValueError names the first Gaussian).
    """
    if not bool((_pose_errors(pose) <= 1).all()):  # NaN is not either
        raise_for_pose(pose)
    means, quats, scales, opacities = gaussians
    # NaN fails every comparison, so that these find it too.
    valid = {
        "means": (means.abs() <= FARTHEST).all(-1),
        "quats": torch.isfinite(quats).all(-1),
        "scales": ((scales >= 0) & (scales <= WIDEST)).all(-1),
        "opacities": (opacities >= 0) & (opacities <= 1),
    }
    for name, ok in valid.items():
        if not bool(ok.all()):
            # The first that is not: torch has no argmin of bool.
            raise_for_parameter(name, int(torch.argmin(ok.to(torch.int8))))


@full_precision
def _pose_errors(pose: Pose) -> Tensor:
    """How far P poses are from sound ones, (P,)
    in units of what `sound_pose` of csrc/pose.h allows.
    """
    rotation, still = pose.rotation, torch.eye(3).to(pose.rotation)
    far = pose.position.abs().amax(1) / FARTHEST
    products = (rotation.mT @ rotation - still).abs().flatten(1).amax(1) / SKEW
    # A mirror's is not 0
    across = torch.linalg.cross(rotation[:, 1], rotation[:, 2]) - rotation[:, 0]
    return torch.stack([far, products, across.abs().amax(1) / (2 * SKEW)]).amax(0)


def raise_for_status(status: int, pose: Pose) -> None:
    """Raise for a plan's status: UNSOUND_POSE, EQUAL_IDS, 4 * Gaussian + parameter,
    or -1 if valid.
    """
    if status < 0:
        return
    if status == calls.kernels().UNSOUND_POSE:
        raise_for_pose(pose)
    if status == calls.kernels().EQUAL_IDS:
        raise_for_ids()
    raise_for_parameter(Gaussians._fields[status % 4], status // 4)


def raise_for_parameter(name: str, index: int) -> None:
    """Raise for the invalid parameter `name` of Gaussian `index` (UnsoundGaussian)."""
    expected = {
        "means": f"finite and within {FARTHEST:.0e} m",
        "scales": f"finite and from 0 to {WIDEST:.0e} m",
        "opacities": "in [0, 1]",
    }.get(name, "finite")
    raise UnsoundGaussian(
        f"Gaussian {index} has {name} that are not {expected}; find where they come from", index
    )


def raise_for_pose(pose: Pose) -> None:
    """Raise for that of P poses which is least a pose (ValueError)."""
    index = int(torch.argmax(_pose_errors(pose).nan_to_num(nan=math.inf)))
    raise ValueError(
        f"pose {index} is not finite, not within {FARTHEST:.0e} m, or its matrix is no rotation; "
        "look at its position and its rotation"
    )


def raise_for_ids() -> None:
    """Raise for Gaussians that no order tells apart (ValueError)."""
    raise ValueError(
        "Gaussians at one distance have equal ids, so nothing orders them; give each its own id"
    )


def features_per_pose(values: Tensor, means: Tensor, pose: Pose) -> Tensor:
    """Return features (N, C) or (B, N, C) as (B, N, C),
    one a Gaussian and pose (ValueError, TypeError).
    """
    _check_dtype_and_device("features", values, means)
    if values.dim() not in (2, 3) or values.shape[-2] != means.shape[0]:
        raise ValueError(
            f"features must be ({means.shape[0]}, C) or (B, {means.shape[0]}, C), got "
            f"{tuple(values.shape)}"
        )
    poses = len(pose)
    if values.dim() == 2:
        return values.expand(poses, *values.shape)
    if poses not in (1, values.shape[0]):
        raise ValueError(f"{values.shape[0]} samples need one pose or as many, got {poses} poses")
    return values


def check_features(values: Tensor, rows: Tensor | None = None) -> None:
    """Check that features (..., N, C) on the CPU are finite (UnsoundGaussian;
    of `rows` (N,) where given).
    """
    if values.device.type != "cpu":  # a GPU is not waited for: NaN stays NaN
        return
    numbers, axis = unwrap(values, values.dim() - 2)
    if not math.isfinite(numbers.sum().item()):  # one pass; a sum may overflow where no number does
        bad = (~torch.isfinite(numbers)).movedim(axis, 0).flatten(1).any(1)
        if bool(bad.any()):
            index = torch.argmax(bad.to(torch.int8))
            raise_for_parameter("features", int(index if rows is None else rows[index]))


def seen_features(values: Tensor, order: Tensor, visible_only: bool) -> Tensor:
    """Return features (B, N, C) of `order` (V,), or those already `visible_only`,
    side by side (V, B C).

    Raises:
        ValueError: features that are not finite or too few, on the CPU.
    """
    if (
        not visible_only
        and not values.is_cuda
        and len(order)
        and int(order.max()) >= values.shape[1]
    ):
        raise ValueError(
            f"this view shows Gaussian {int(order.max())}, got features of {values.shape[1]}"
        )
    seen = values if visible_only else values.index_select(1, order)
    check_features(seen, order)
    return seen.transpose(0, 1).reshape(seen.shape[1], values.shape[0] * values.shape[2])


def check_poses(pose: Pose, means: Tensor) -> Pose:
    """Return poses (P,) in the Gaussians' dtype, on their device (TypeError);
    the plan checks values.
    """
    for name, part in vars(pose).items():
        if part.dtype not in (torch.float32, torch.float64):
            raise TypeError(
                f"a pose needs float32 or float64, got a {name} in {part.dtype}; convert it"
            )
    ends = (pose.position, pose.rotation)
    fits = all(t.dtype == means.dtype and t.device == means.device for t in ends) and pose.batched
    if (
        fits
        and not transform_is_active()
        and not any(t.requires_grad or not t.is_contiguous() for t in ends)
    ):
        return pose  # as most often: what follows takes longer than planning a hundred Gaussians
    position = pose.position.detach().to(means).reshape(-1, 3).contiguous()
    rotation = pose.rotation.detach().to(means).reshape(-1, 3, 3).contiguous()
    return Pose(position, rotation)


def _check_dtype_and_device(name: str, tensor: Tensor, means: Tensor) -> None:
    if tensor.dtype != means.dtype:
        raise TypeError(f"{name} is {tensor.dtype} but means is {means.dtype}; convert one of them")
    if tensor.device != means.device:
        raise ValueError(
            f"{name} is on {tensor.device} but means is on {means.device}; move one of them"
        )

"""What comes in is checked once, here; an error is one line saying what to change."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import built
from gsparc.ops.geometry import Gaussians, Pose
from gsparc.ops.settings import FARTHEST, WIDEST


class UnsoundGaussian(ValueError):
    """A Gaussian that no footprint can be made of.

    Attributes:
        index: its row.
    """

    def __init__(self, message: str, index: int) -> None:
        super().__init__(message)
        self.index = index


def gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    ids: Tensor | None,
) -> Gaussians:
    """Gaussians whose shapes, dtypes and devices agree (ValueError, TypeError)."""
    n = means.shape[0] if means.dim() else 0
    given = Gaussians(means, quats, scales, opacities, extinctions)
    expected = ((n, 3), (n, 4), (n, 3), (n,), (n,))
    for name, tensor, shape in zip(Gaussians._fields, given, expected, strict=True):
        if tensor is None:
            continue
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must be {shape} for {n} means, got {tuple(tensor.shape)}")
        _same_kind(name, tensor, means)
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"the rasterizer computes in float32 or float64, got means in {means.dtype}")
    if ids is not None and (
        tuple(ids.shape) != (n,) or ids.dtype != torch.int64 or ids.device != means.device
    ):
        raise ValueError(f"ids must be ({n},) int64 on {means.device}, got {tuple(ids.shape)} {ids.dtype}")
    return given


def finite(gaussians: Gaussians, pose: Pose) -> None:
    """Refuse what no footprint can be made of (ValueError), naming the first Gaussian, or a pose."""
    if not all(bool(torch.isfinite(part).all()) for part in (pose.position, pose.rotation)):
        raise_for_pose()
    means, quats, scales, strongest, _ = gaussians
    sound = {
        "means": (means.abs() <= FARTHEST).all(-1),
        "quats": torch.isfinite(quats).all(-1),
        "scales": ((scales >= 0) & (scales <= WIDEST)).all(-1),
        "opacities": (strongest >= 0) & (strongest <= 1),
    }
    for name, ok in sound.items():
        if not bool(ok.all()):
            raise_for(name, int(torch.argmin(ok.to(torch.int8))))


def strongest(gaussians: Gaussians) -> Gaussians:
    """The larger of opacity and extinction as the opacity; the smaller where it is negative, an error."""
    opacities, extinctions = gaussians.opacities, gaussians.extinctions
    if extinctions is None:
        return gaussians
    least = torch.minimum(opacities, extinctions)
    larger = torch.where(least < 0, least, torch.maximum(opacities, extinctions))
    return gaussians._replace(opacities=larger, extinctions=None)


def raise_for_verdict(verdict: int) -> None:
    """The error for what a plan found, if it is not -1: UNSOUND_POSE, or 4 * Gaussian + which parameter."""
    if verdict == built.kernels().UNSOUND_POSE:
        raise_for_pose()
    if verdict >= 0:
        raise_for(Gaussians._fields[verdict % 4], verdict // 4)


def raise_for(name: str, index: int) -> None:
    """The error for Gaussian `index` whose `name` no footprint can be made of (UnsoundGaussian)."""
    wanted = {
        "means": f"finite and within {FARTHEST:.0e} m",
        "scales": f"finite and from 0 to {WIDEST:.0e} m",
        "opacities": "in [0, 1], extinctions included",
    }.get(name, "finite")
    raise UnsoundGaussian(
        f"Gaussian {index} has {name} that are not {wanted}; find where they come from", index
    )


def raise_for_pose() -> None:
    """The error for a pose that no direction can be told from (ValueError)."""
    raise ValueError("a pose is not finite; look at the positions and rotations of this batch")


def features(values: Tensor, means: Tensor, pose: Pose) -> Tensor:
    """Features (N, C) or (B, N, C) as (B, N, C), checked against the Gaussians and the poses (ValueError)."""
    _same_kind("features", values, means)
    if values.dim() not in (2, 3) or values.shape[-2] != means.shape[0]:
        raise ValueError(
            f"features must be ({means.shape[0]}, C) or (B, {means.shape[0]}, C), got {tuple(values.shape)}"
        )
    poses = len(pose)
    if values.dim() == 2:
        return values.expand(poses, *values.shape)
    if poses not in (1, values.shape[0]):
        raise ValueError(f"{values.shape[0]} samples need one pose or as many, got {poses} poses")
    return values


def poses(pose: Pose, means: Tensor) -> Pose:
    """Poses (P,) in the Gaussians' dtype and on their device, always batched; plans look if finite."""
    position = pose.position.detach().to(means).reshape(-1, 3).contiguous()
    rotation = pose.rotation.detach().to(means).reshape(-1, 3, 3).contiguous()
    return Pose(position, rotation)


def _same_kind(name: str, tensor: Tensor, means: Tensor) -> None:
    if tensor.dtype != means.dtype:
        raise TypeError(f"{name} is {tensor.dtype} but means is {means.dtype}; convert one of them")
    if tensor.device != means.device:
        raise ValueError(f"{name} is on {tensor.device} but means is on {means.device}; move one of them")

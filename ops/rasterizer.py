"""The public functions: plan, composite, mean weights and freeze, on any backend."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import torch
from torch import Tensor

from gsparc.ops import backends, reference_by_rows, validation
from gsparc.ops.frozen import FrozenPlan
from gsparc.ops.geometry import Gaussians, Pose, SphereGrid
from gsparc.ops.projection import Projection
from gsparc.ops.results import Plan, Raster, Weights
from gsparc.ops.settings import IMAGE_CUTOFF, Cutoff, Optics
from gsparc.ops.transforms import detach, needs_reference, no_transforms


def make_plan(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    pose: Pose,
    grid: SphereGrid,
    *,
    projection: Projection = "tangent",
    low_pass: float = 0.3,
    compensate: bool = True,
    near: float = 0.01,
    cutoff: Cutoff = IMAGE_CUTOFF,
    ids: Tensor | None = None,
    backend: str | None = None,
) -> Plan:
    """Project N Gaussians for P poses, cull, order by (distance, id) and bin. No gradients.

    Args:
        means: (N, 3) [m], in the frame of the pose's position.
        quats: (N, 4) w x y z, any length; the zero quaternion means no rotation.
        scales: (N, 3) standard deviations [m].
        opacities: (N,) in [0, 1].
        pose: one pose for a whole batch, or P of them.
        grid: directions of the pixels.
        projection, low_pass, compensate, near, cutoff: see `Optics`.
        ids: (N,) int64, permanent ids that break ties of distance; the row number by default.
        backend: "reference", "cpu" or "cuda"; by default the one of the tensors' device.

    Raises:
        ValueError, TypeError: for invalid shapes, dtypes, devices or values.
        BackendUnavailable: if the backend was not built or does not serve this device.
    """
    gaussians = validation.check_gaussians(means, quats, scales, opacities, ids)
    optics = Optics(projection, low_pass, compensate, near, cutoff)
    return _make_plan(gaussians, ids, pose, grid, optics, backend)


def _make_plan(
    gaussians: Gaussians,
    ids: Tensor | None,
    pose: Pose,
    grid: SphereGrid,
    optics: Optics,
    backend: str | None,
) -> Plan:
    """`make_plan` of Gaussians whose shapes agree."""
    # Read before `detach`, which takes gradients off: a pose's would then be none without a word.
    pose_trained = pose.position.requires_grad or pose.rotation.requires_grad
    validation.check_transforms(gaussians, pose, pose_trained)
    chosen = backends.choose_backend(backend, gaussians.means.device)
    with torch.no_grad() if torch.is_grad_enabled() else nullcontext(), no_transforms():
        # Order and visibility are choices without a derivative:
        # neither autograd nor `torch.func` sees them.
        still = Gaussians._make(map(detach, gaussians))
        poses = validation.check_poses(
            Pose(detach(pose.position), detach(pose.rotation)), still.means
        )
        plan = chosen.make_plan(still, detach(ids), poses, grid, optics)
    return replace(plan, pose_trained=True) if pose_trained else plan


def _check_against_plan(plan: Plan, *parameters: Tensor) -> Gaussians:
    """Validated Gaussians, as many as `plan` was made from (ValueError, TypeError)."""
    gaussians = validation.check_gaussians(*parameters, ids=None)  # type: ignore[arg-type, misc]
    validation.check_transforms(gaussians, plan.pose, plan.pose_trained)
    if plan.num_gaussians != len(gaussians.means):
        raise ValueError(
            f"this plan holds {plan.num_gaussians} Gaussians, got {len(gaussians.means)}; plan "
            "again"
        )
    return gaussians


def _needs_gradient(plan: Plan, *tensors: Tensor) -> bool:
    """Whether gradients of the tensors are asked for (RuntimeError
    where the plan does not allow it).
    """
    requires_grad = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    # Tensors of inference mode can never become part of a graph.
    if requires_grad and plan.means2d.is_inference():
        raise RuntimeError(
            "this plan was made in torch.inference_mode, so nothing can be trained over it: plan "
            "outside, "
            "or under torch.no_grad"
        )
    return requires_grad


def composite(
    plan: Plan,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
) -> Raster:
    """Blend features front to back over a plan made from the same Gaussians;
    differentiable in every tensor.

    Under `torch.func` and in forward mode plain PyTorch computes it, slowly.
    `features` is (N, C) or (B, N, C), real.
    With one pose the weights are formed once for all B C channels.

    Raises:
        ValueError, TypeError: shapes, dtypes or devices disagree, or the plan is of another number.
        RuntimeError: gradients over a plan that was made in `torch.inference_mode`.
    """
    gaussians = _check_against_plan(plan, means, quats, scales, opacities)
    values = validation.features_per_pose(features, means, plan.pose)
    validation.check_features(features)
    # Kernels have first derivatives in reverse mode alone.
    plain = needs_reference(*gaussians, features)
    trained = _needs_gradient(plan, *gaussians, features) and not plain
    # A leaf of its own: after `backward` its `.grad` is the screen-space gradient
    # that densification reads.
    means2d = plan.means2d.clone().requires_grad_() if trained else plan.means2d
    backend = reference_by_rows if plain else backends.backend_named(plan.backend)
    image, transmittance = backend.composite(plan, gaussians, values, means2d)
    return Raster(image, transmittance, plan.radii, plan.visible, means2d)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    pose: Pose,
    grid: SphereGrid,
    *,
    projection: Projection = "tangent",
    low_pass: float = 0.3,
    compensate: bool = True,
    near: float = 0.01,
    cutoff: Cutoff = IMAGE_CUTOFF,
    ids: Tensor | None = None,
    backend: str | None = None,
) -> Raster:
    """Render features (N, C) or (B, N, C), real, for each pose: `make_plan`, then `composite`.

    Takes the arguments and raises the errors of both. Gradients reach all tensors but the pose's.

    >>> pose, grid = Pose.identity(torch.zeros(3)), SphereGrid.hemisphere(9, 36)
    >>> means, quats = torch.tensor([[4.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    >>> scales, opacities, features = torch.full((1, 3), 0.5), torch.tensor([0.8]), torch.ones(1, 1)
    >>> raster = rasterize(means, quats, scales, opacities, features, pose, grid)
    >>> raster.image.shape, raster.transmittance.shape
    (torch.Size([1, 1, 9, 36]), torch.Size([1, 9, 36]))

    One feature, of 1:

    >>> bool(torch.allclose(raster.image[0], 1 - raster.transmittance, atol=1e-6))
    True
    """
    gaussians = validation.check_gaussians(means, quats, scales, opacities, ids)
    optics = Optics(projection, low_pass, compensate, near, cutoff)
    plan = _make_plan(gaussians, ids, pose, grid, optics, backend)
    return composite(plan, means, quats, scales, opacities, features)


def mean_weights(
    plan: Plan,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
) -> Weights:
    """Return each Gaussian's visible weight for each pose, by a plan of the same ones;
    differentiable.

    Raises:
        ValueError, TypeError, RuntimeError: as `composite`.
    """
    gaussians = _check_against_plan(plan, means, quats, scales, opacities)
    # Called for its refusal of plans that were made in inference mode.
    _needs_gradient(plan, *gaussians)
    backend = (
        reference_by_rows if needs_reference(*gaussians) else backends.backend_named(plan.backend)
    )
    return backend.mean_weights(plan, gaussians)


@torch.no_grad()
def freeze(
    plan: Plan,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    *,
    version: int,
) -> FrozenPlan:
    """Store one static receiver's weights as a sparse pixel x Gaussian matrix, valid for `version`.

    `version` is the field's own counter, raised whenever its geometry or opacity changes; a
    tensor's hidden counter misses writes through `.data`.

    Raises:
        ValueError: a plan of more than one pose.
        RuntimeError: under `torch.func` and in forward mode; a view has no derivatives.
    """
    if plan.num_poses != 1:
        raise ValueError(f"only the view of one pose can be frozen, this plan has {plan.num_poses}")
    gaussians = _check_against_plan(plan, means, quats, scales, opacities)
    # To `torch.func` a frozen view would be a constant, its derivative 0 without a word.
    if needs_reference(*gaussians):
        raise RuntimeError(
            "a frozen view has no derivatives: composite the plan instead of freezing it"
        )
    order, buffers = backends.backend_named(plan.backend).freeze(plan, gaussians)
    return FrozenPlan(plan.grid, plan.backend, version, order, buffers)

"""The `reference` backend: plans and composites with dense tensors and autograd.

Half precision of `torch.autocast` is switched off here;
a backward pass must itself be outside of it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.ops import reference, validation
from gsparc.ops.geometry import Gaussians, Pose, SphereGrid
from gsparc.ops.results import Plan, Weights, visible_share
from gsparc.ops.settings import Optics
from gsparc.ops.transforms import full_precision


@full_precision
def make_plan(
    gaussians: Gaussians, ids: Tensor | None, pose: Pose, grid: SphereGrid, optics: Optics
) -> Plan:
    """Find depth order and radii; compositing evaluates the footprints again, differentiably."""
    validation.check_finite(gaussians, pose)
    means, quats, scales, opacities = gaussians
    orders, centers, radii, visible = [], [], [], []
    for index in range(len(pose)):
        seen = reference.project(means, quats, scales, pose[index], grid, optics)
        shapes = reference.footprints(seen, grid, optics, torch.zeros_like(means[:, :2]))
        alpha = reference.layer_opacities(seen, shapes, opacities, optics)
        orders.append(reference.depth_order(seen, ids))
        # An absent Gaussian, such as one at the receiver, has no centre that may be read.
        centers.append(torch.where(seen.present[:, None], seen.center, 0.0))
        visible.append((alpha > 0).any(1))
        if ids is not None:
            # The visible ones by depth: neighbours of equal distance and equal id have no order.
            ranks = orders[-1][visible[-1][orders[-1]]]
            if bool(((seen.distance[ranks].diff() == 0) & (ids[ranks].diff() == 0)).any()):
                validation.raise_for_ids()
        radii.append(torch.where(visible[-1], reference.cutoff_radii(seen, opacities, optics), 0.0))
    return Plan(
        *(pose, grid, optics, "reference"),
        means2d=_stack_or_empty(centers, means.new_empty(0, len(means), 2)),
        radii=_stack_or_empty(radii, means.new_empty(0, len(means))),
        visible=_stack_or_empty(visible, means.new_empty(0, len(means), dtype=torch.bool)),
        buffers=(_stack_or_empty(orders, means.new_empty(0, len(means), dtype=torch.int64)),),
    )


@full_precision
def composite(
    plan: Plan, gaussians: Gaussians, features: Tensor, means2d: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the image (B, C, H, W) and transmittance (P, H, W) of features (B, N, C)."""
    per_pose = features.unsqueeze(0) if plan.num_poses == 1 else features.unsqueeze(1)
    images, transmittances = [], []
    for index, values in enumerate(per_pose):
        weights, _, transmittance = _weights(plan, index, gaussians, means2d)
        order = plan.buffers[0][index]
        images.append(torch.einsum("nu,bnc->bcu", weights, values[:, order]))
        transmittances.append(transmittance)
    size = (plan.grid.height, plan.grid.width)
    # No poses: images of no rows that all the same depend on the tensors, with a gradient of 0.
    none = _zero_of(*gaussians, features)
    image = torch.cat(images) if images else none.expand(0, features.shape[2], size[0] * size[1])
    transmittance = _stack_or_empty(transmittances, none.expand(0, size[0] * size[1]))
    return image.unflatten(-1, size), transmittance.unflatten(-1, size)


@full_precision
def weight_sums(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Return sums over pixels of alpha T and of alpha, both (P, N)."""
    seen, total = [], []
    no_shift = torch.zeros_like(plan.means2d)
    for index in range(plan.num_poses):
        weights, alpha, _ = _weights(plan, index, gaussians, no_shift)
        # From the order of depth back to the order of the Gaussians.
        inverse = torch.argsort(plan.buffers[0][index])
        seen.append(weights.sum(1)[inverse])
        total.append(alpha.sum(1)[inverse])
    none = _zero_of(*gaussians).expand(0, len(gaussians.means))
    return _stack_or_empty(seen, none), _stack_or_empty(total, none)


def mean_weights(plan: Plan, gaussians: Gaussians) -> Weights:
    """Return the mean over pixels of alpha T, and its share of alpha: both (P, N)."""
    seen, total = weight_sums(plan, gaussians)
    return Weights(seen / (plan.grid.height * plan.grid.width), visible_share(seen, total))


@full_precision
def freeze(plan: Plan, gaussians: Gaussians) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return the depth order (N,) of the only pose, and the weights alpha T (N, H W)
    in that order.
    """
    # No shift of centres: a view is frozen for inference.
    no_shift = torch.zeros_like(plan.means2d)
    weights, _, _ = _weights(plan, 0, gaussians, no_shift)
    return plan.buffers[0][0], (weights,)


@full_precision
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
    columns = validation.seen_features(features, order, visible_only)
    return (columns.mT @ buffers[0]).unflatten(-1, (grid.height, grid.width))


def _stack_or_empty(parts: list[Tensor], none: Tensor) -> Tensor:
    """What there is for each pose (P, ...); `none` (0, ...) where there is no pose."""
    return torch.stack(parts) if parts else none


def _zero_of(*tensors: Tensor) -> Tensor:
    """0, a function of the tensors: their gradient is 0 rather than absent."""
    return torch.stack([t[:0].sum() for t in tensors]).sum()


def _weights(
    plan: Plan, index: int, gaussians: Gaussians, means2d: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """For a pose and the Gaussians in depth order: alpha T (N, H W), alpha (N, H W),
    transmittance (H W,).
    """
    order = plan.buffers[0][index]
    near = Gaussians._make(t[order] for t in gaussians)
    seen = reference.project(
        near.means, near.quats, near.scales, plan.pose[index], plan.grid, plan.optics
    )
    # Zero in value, with the slope of the centres on the screen.
    shift = (means2d[index] - means2d[index].detach())[order]
    shapes = reference.footprints(seen, plan.grid, plan.optics, shift)
    alpha = reference.layer_opacities(seen, shapes, near.opacities, plan.optics)
    before, transmittance = reference.transmittances(alpha, plan.optics.cutoff.transmittance)
    return alpha * before, alpha, transmittance

"""The rasterizer in plain PyTorch, which the kernels are tested against. Dense,
so for small scenes only.

Everything is differentiable by autograd, in float32 and float64. Notation: mu mean, n unit
direction from the receiver, r distance, M = R^T R_q diag(s) / r the angular square root of the
covariance, K2 the covariance of the footprint [px^2].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.ops.geometry import Pose, SphereGrid
from gsparc.ops.projection import PROJECTIONS
from gsparc.ops.settings import ALPHA_MAX, SHORTEST_QUATERNION, Optics


@dataclass(frozen=True)
class Projected:
    """N Gaussians as one receiver sees them.

    Attributes:
        present: (N,) bool, farther than `near`, with a footprint that is not degenerate.
        distance: (N,) [m].
        direction, east, north: (N, 3) unit vectors, receiver frame; east and north span the tangent
            plane.
        center: (N, 2) (column, row) [px].
        covariance: (N, 3) [px^2], entries 11, 12, 22 with the low-pass; 1 is east or column.
        determinant: (N,) [px^4] of the same, formed without subtracting.
        gain: (N,) what multiplies an opacity: near fade times energy compensation.
    """

    present: Tensor
    distance: Tensor
    direction: Tensor
    east: Tensor
    north: Tensor
    center: Tensor
    covariance: Tensor
    determinant: Tensor
    gain: Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return rotations (N, 3, 3) of quaternions (N, 4) w x y z of any length;
    the zero one does not turn.

    >>> rotation_matrices(torch.tensor([[0.0, 0.0, 0.0, 2.0]]))[0].diagonal()  # half a turn about z
    tensor([-1., -1.,  1.])
    """
    longest = quats.detach().abs().amax(-1, keepdim=True)
    usable = longest > SHORTEST_QUATERNION
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    # By the longest component first: squares of 1e-20 and 1e20 are no float32 numbers.
    sized = torch.where(usable, quats / torch.where(usable, longest, 1.0), identity)
    w, x, y, z = (sized / (sized * sized).sum(-1, keepdim=True).sqrt()).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _norm(vectors: Tensor) -> Tensor:
    """Length along the last axis, with gradient 0 where it is 0."""
    square = (vectors * vectors).sum(-1)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, pose: Pose, grid: SphereGrid, optics: Optics
) -> Projected:
    """Return footprints of N Gaussians for one pose (position (3,), rotation (3, 3))."""
    local = pose.local(means)
    with torch.no_grad():
        distance = _norm(local)
        present = distance > optics.near
    # Absent Gaussians are moved to a harmless place: no NaN in forward or backward,
    # and no gradient.
    local = torch.where(present[:, None], local, torch.ones_like(local))
    distance = _norm(local)
    n = local / distance[:, None]
    on_axis = (n[:, :2] * n[:, :2]).sum(-1, keepdim=True) == 0
    # By the longer side first: slopes of the root and of atan2 have squares of 1e-20,
    # no float32 numbers.
    longer = torch.where(on_axis, 1.0, n[:, :2].detach().abs().amax(-1, keepdim=True))
    sides = n[:, :2] / longer
    length = _norm(sides)[:, None]
    horizontal = (longer * length)[:, 0]
    forward = torch.tensor([1.0, 0.0], dtype=means.dtype, device=means.device)
    cos_sin = torch.where(on_axis, forward, sides / torch.where(on_axis, 1.0, length))
    zero = torch.zeros_like(horizontal)
    # Unit vectors along growing azimuth and growing elevation.
    east = torch.stack([-cos_sin[:, 1], cos_sin[:, 0], zero], -1)
    north = torch.stack([-n[:, 2] * cos_sin[:, 0], -n[:, 2] * cos_sin[:, 1], horizontal], -1)
    elevation = torch.atan2(n[:, 2], horizontal)
    x, y = torch.where(on_axis, forward, sides).unbind(-1)
    azimuth = torch.atan2(y, x)

    frame = PROJECTIONS[optics.projection].frame
    to_column, east, north = frame(n, east, north, horizontal, grid)
    to_row = 1 / grid.elevation_step

    axes = pose.rotation.mT @ rotation_matrices(quats)
    angular = scales / distance[:, None]
    columns = axes * angular[:, None, :]
    # Rows of the square root V of the footprint's covariance, K2 = V V^T.
    v1 = to_column[:, None] * torch.einsum("nk,nki->ni", east, columns)
    v2 = to_row * torch.einsum("nk,nki->ni", north, columns)
    k11, k12, k22 = (v1 * v1).sum(-1), (v1 * v2).sum(-1), (v2 * v2).sum(-1)
    # det(P M M^T P) = |cof(M)^T n|^2: exact for needles and pancakes,
    # where k11 k22 - k12^2 cancels.
    cofactors = torch.stack(
        [
            angular[:, 1] * angular[:, 2],
            angular[:, 0] * angular[:, 2],
            angular[:, 0] * angular[:, 1],
        ],
        -1,
    )
    area = to_column * to_row * _norm(cofactors * torch.einsum("nki,nk->ni", axes, n))
    eps = optics.low_pass
    # det(K + eps 1) = det K + eps trace K + eps^2: a sum of positive terms, nothing cancels.
    determinant = area**2 + eps * (k11 + k22) + eps**2
    sharp = (determinant > torch.finfo(means.dtype).tiny) & (
        k22 + eps > torch.finfo(means.dtype).tiny
    )
    determinant, k22 = torch.where(sharp, determinant, 1.0), torch.where(sharp, k22, 1.0)

    fade = ((distance - optics.near) / optics.near).clamp(0, 1)
    # A smoothstep: value and slope are continuous where it begins and ends.
    gain = fade**2 * (3 - 2 * fade)
    if optics.compensate:
        # A footprint holds its peak times the root of its determinant,
        # which was `area` before the low-pass.
        gain = gain * area / determinant.sqrt()
    return Projected(
        present=present & sharp,
        distance=distance,
        direction=n,
        east=east,
        north=north,
        center=torch.stack(
            [
                (azimuth - grid.first_azimuth) / grid.azimuth_step,
                (elevation - grid.first_elevation) / grid.elevation_step,
            ],
            -1,
        ),
        covariance=torch.stack([k11 + eps, k12, k22 + eps], -1),
        determinant=determinant,
        gain=gain,
    )


def footprints(seen: Projected, grid: SphereGrid, optics: Optics, shift: Tensor) -> Tensor:
    """Return the Gaussians' shapes G (N, H W), 1 at their centres,
    0 where a pixel does not face them.

    `shift` (N, 2) [px] moves the footprints; it is zero and carries the screen-space gradient.
    """
    p, q, facing = PROJECTIONS[optics.projection].offsets(seen, grid, shift)
    _, k12, k22 = (entry[:, None] for entry in seen.covariance.unbind(-1))
    # The quadratic form completed to squares: no cancellation along a needle. Roots first: the
    # slope of k22 / det overflows in float32 long before theirs.
    root = k22.sqrt()
    form = (root / seen.determinant[:, None].sqrt() * (p - k12 / k22 * q)) ** 2 + (q / root) ** 2
    return torch.where(facing & seen.present[:, None], torch.exp(-0.5 * form), 0.0)


def depth_order(seen: Projected, ids: Tensor | None) -> Tensor:
    """Return indices (N,) from near to far, equal distances by id."""
    by_id = (
        torch.arange(len(seen.distance), device=seen.distance.device)
        if ids is None
        else torch.argsort(ids)
    )
    # A stable sort by distance after one by id: equal distances stay in the order of ids.
    return by_id[torch.argsort(seen.distance.detach()[by_id], stable=True)]


def layer_opacities(seen: Projected, shapes: Tensor, opacities: Tensor, optics: Optics) -> Tensor:
    """Return the opacity alpha of each layer at each pixel (N, H W), before occlusion."""
    alpha = (seen.gain * opacities)[:, None] * shapes
    strength = shapes if optics.cutoff.relative else alpha
    # Whether a layer counts is a choice without a derivative.
    counts = ((strength >= optics.cutoff.alpha) & (alpha > 0)).detach()
    return torch.where(counts, alpha, 0.0).clamp(max=ALPHA_MAX)


def transmittances(alpha: Tensor, floor: float) -> tuple[Tensor, Tensor]:
    """Return transmittance before each layer (N, H W), 0 once below `floor`,
    and behind all layers (H W,).

    >>> before, behind = transmittances(torch.tensor([[0.5], [0.5]]), 0.0)
    >>> before[:, 0].tolist(), behind.tolist()
    ([1.0, 0.5], [0.25])
    """
    clear = alpha.new_ones(1, alpha.shape[1])
    with torch.no_grad():
        lit = torch.cumprod(torch.cat([clear, 1 - alpha]), 0)[:-1] >= floor
    # Layers that the floor cuts off neither emit nor hide;
    # a product of factors up to 1 never rises again.
    light = torch.cumprod(torch.cat([clear, 1 - torch.where(lit, alpha, 0.0)]), 0)
    return torch.where(lit, light[:-1], 0.0), light[-1]


def cutoff_radii(seen: Projected, opacities: Tensor, optics: Optics) -> Tensor:
    """Return long half axes (N,) [px] at the cut-off."""
    k11, k12, k22 = seen.covariance.unbind(-1)
    # The larger eigenvalue of a symmetric 2 x 2 matrix;
    # `hypot` does not overflow where squares would.
    largest = (k11 + k22) / 2 + torch.hypot((k11 - k22) / 2, k12)
    peak = torch.ones_like(opacities) if optics.cutoff.relative else seen.gain * opacities
    # The half axis r at which peak exp(-r^2 / (2 eigenvalue)) has fallen to the cut-off.
    reach = 2 * torch.log(torch.where(seen.present, peak, 0.0) / optics.cutoff.alpha)
    return (reach.clamp(min=0) * largest).sqrt()

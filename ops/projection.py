"""Projections of a Gaussian onto the sphere of directions: what each adds to the reference,
by name.

The kernels have a class of the same name for each in csrc/projection/.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor

from gsparc.ops.geometry import SphereGrid

if TYPE_CHECKING:
    from gsparc.ops.reference import Projected

Projection = Literal["tangent", "equirect"]

HORIZON_COSINE = 0.01
"""`tangent` only: pixels more than 89.4 degrees from a Gaussian's direction never see it (the
tangent plane ends at 90 degrees, and float32 has lost two digits of the offset before that)."""


class Reference(NamedTuple):
    """One projection in plain PyTorch.

    Attributes:
        frame: of directions, east, north (N, 3) and the cosines of the elevations (N,): the pixels
            per radian to the east (N,), and east and north as the gradient carries them.
        offsets: of projected Gaussians, a grid and a shift (N, 2) [px] of the footprints (zero; it
            carries the screen-space gradient): offsets (N, H W) of every pixel from every centre in
                columns and rows
            [px], and whether the pixel is in front.
    """

    frame: Callable[[Tensor, Tensor, Tensor, Tensor, SphereGrid], tuple[Tensor, Tensor, Tensor]]
    offsets: Callable[[Projected, SphereGrid, Tensor], tuple[Tensor, Tensor, Tensor]]


def _tangent_frame(
    direction: Tensor, east: Tensor, north: Tensor, cosine: Tensor, grid: SphereGrid
) -> tuple[Tensor, Tensor, Tensor]:
    # The footprint is the same in any frame of the plane: this one is carried along without
    # turning, so that float32 loses nothing to the turn of east and north, which is infinite at the
    # pole. It is turned from where it stands to n,
    # so that it stays orthonormal in every order of derivative.
    n, still = direction, direction.detach()
    halfway = (n + still) / (1 + (n * still).sum(-1, keepdim=True))
    east, north = (
        e - halfway * (n * e).sum(-1, keepdim=True) for e in (east.detach(), north.detach())
    )
    # A pixel of the tangent plane is one elevation step in both directions, at any elevation.
    return torch.full_like(cosine, 1 / grid.elevation_step), east, north


def _tangent_offsets(
    seen: Projected, grid: SphereGrid, shift: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    u = grid.directions(shift.dtype).to(shift.device).flatten(0, 1)
    cosine = seen.direction @ u.mT
    facing = cosine > HORIZON_COSINE
    # Beyond the horizon a division by nearly 0 would give gradients of NaN to pixels
    # that do not count.
    cosine = torch.where(facing, cosine, 1.0)
    p, q = (seen.east @ u.mT) / cosine, (seen.north @ u.mT) / cosine
    # Moving the centre by d along the sphere moves the offset by -(d + q (q . d))
    # (gnomonic projection).
    d = shift * grid.elevation_step
    along = d[:, :1] * p + d[:, 1:] * q
    p, q = p - (d[:, :1] + p * along), q - (d[:, 1:] + q * along)
    return p / grid.elevation_step, q / grid.elevation_step, facing


def _equirect_frame(
    direction: Tensor, east: Tensor, north: Tensor, cosine: Tensor, grid: SphereGrid
) -> tuple[Tensor, Tensor, Tensor]:
    # At the pole a radian to the east is infinitely many columns: one step of elevation bounds it.
    return 1 / ((cosine**2 + grid.elevation_step**2).sqrt() * grid.azimuth_step), east, north


def _equirect_offsets(
    seen: Projected, grid: SphereGrid, shift: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    center = seen.center + shift
    column = torch.arange(grid.width, dtype=shift.dtype, device=shift.device) - center[:, :1]
    row = torch.arange(grid.height, dtype=shift.dtype, device=shift.device) - center[:, 1:]
    turn = grid.per_turn
    # The shorter way around the circle; which way it is has no derivative.
    column = column - turn * torch.round(column.detach() / turn)
    size = (-1, grid.height, grid.width)
    p, q = column[:, None, :].expand(size).flatten(1), row[:, :, None].expand(size).flatten(1)
    return p, q, torch.ones_like(p, dtype=torch.bool)


PROJECTIONS: dict[str, Reference] = {
    "tangent": Reference(_tangent_frame, _tangent_offsets),
    "equirect": Reference(_equirect_frame, _equirect_offsets),
}
"""By name, in the order of `GSPARC_PROJECTIONS` in csrc/layout.h."""

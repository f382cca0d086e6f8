"""Gaussians, receiver poses, and the grid of directions that a receiver looks at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class Gaussians(NamedTuple):
    """N Gaussians, of one floating dtype on one device.

    Attributes:
        means: (N, 3) [m].
        quats: (N, 4) w x y z, any length; the zero quaternion means no rotation.
        scales: (N, 3) standard deviations [m].
        opacities: (N,) in [0, 1].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor


@dataclass(frozen=True)
class Pose:
    """Receiver poses.

    >>> Pose.identity(torch.zeros(3)).local(torch.tensor([[1.0, 2.0, 0.5]]))
    tensor([[1.0000, 2.0000, 0.5000]])

    Attributes:
        position: (3,) or (P, 3) [m], world frame.
        rotation: (3, 3) or (P, 3, 3), local to world; columns are the local axes seen from the
            world.
    """

    position: Tensor
    rotation: Tensor

    def __post_init__(self) -> None:
        if self.position.shape[-1:] != (3,) or self.rotation.shape[-2:] != (3, 3):
            raise ValueError(
                f"a pose needs position (..., 3) and rotation (..., 3, 3), "
                f"got {tuple(self.position.shape)} and {tuple(self.rotation.shape)}"
            )
        if self.position.shape[:-1] != self.rotation.shape[:-2] or self.position.dim() > 2:
            raise ValueError(
                f"position and rotation must agree on one optional leading axis, "
                f"got {tuple(self.position.shape)} and {tuple(self.rotation.shape)}"
            )

    @property
    def batched(self) -> bool:
        """Whether there is one pose per sample (P, 3) rather than one for all (3,)."""
        return self.position.dim() == 2

    def __len__(self) -> int:
        return self.position.shape[0] if self.batched else 1

    def __getitem__(self, index: int | slice | Tensor) -> Pose:
        if not self.batched:
            raise TypeError("this pose is shared by all samples and cannot be indexed")
        return Pose(self.position[index], self.rotation[index])

    def to(self, *args, **kwargs) -> Pose:
        """Return the same poses with another dtype or on another device."""
        return Pose(self.position.to(*args, **kwargs), self.rotation.to(*args, **kwargs))

    def local(self, points: Tensor) -> Tensor:
        """Return world points (N, 3) [m] in the receiver frame: (N, 3), or (P, N, 3) for P poses.

        Turned by 90 degrees:

        >>> left = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> Pose(torch.tensor([1.0, 0.0, 0.0]), left).local(torch.tensor([[1.0, 2.0, 0.0]]))
        tensor([[2., 0., 0.]])
        """
        # (x - p) R applies R^T to each row.
        return (points - self.position.unsqueeze(-2)) @ self.rotation

    @staticmethod
    def identity(position: Tensor) -> Pose:
        """Return poses at `position` (3,) or (P, 3) [m] whose local axes are the world's.

        >>> len(Pose.identity(torch.zeros(4, 3)))
        4
        """
        eye = torch.eye(3, dtype=position.dtype, device=position.device)
        # A view of one matrix: P poses cost the memory of one rotation.
        return Pose(position, eye.expand(*position.shape[:-1], 3, 3))


WIDEST_GRID = 32767
"""Most columns of a grid: the kernels count blocks of one to four columns in 16 bits."""


@dataclass(frozen=True)
class SphereGrid:
    """Directions on the receiver's sphere; row i and column j are pixel *centres*.

    Elevation is `atan2(z, hypot(x, y))` in [-pi/2, pi/2], azimuth `atan2(y, x)` up to whole turns,
    both in the receiver's local frame (boresight z).

    >>> SphereGrid.hemisphere(2, 8).elevations().rad2deg()
    tensor([ 0., 45.], dtype=torch.float64)

    Attributes:
        height, width: number of elevations and azimuths.
        first_elevation, first_azimuth: centre of pixel (0, 0) [rad].
        elevation_step, azimuth_step: spacing of the centres, positive [rad].

    Raises:
        ValueError: no pixel, angles that are not finite, rows beyond a pole, columns beyond the
            circle.
    """

    height: int
    width: int
    first_elevation: float
    first_azimuth: float
    elevation_step: float
    azimuth_step: float

    def __post_init__(self) -> None:
        angles = (self.first_elevation, self.first_azimuth, self.elevation_step, self.azimuth_step)
        if not all(map(math.isfinite, angles)):
            raise ValueError(f"a grid needs finite angles, got {self}")
        if self.height < 1 or self.width < 1 or self.elevation_step <= 0 or self.azimuth_step <= 0:
            raise ValueError(f"a grid needs at least one pixel and positive steps, got {self}")
        # With a margin: 360 steps of 2 pi / 360 may round to more than the circle.
        if self.width * self.azimuth_step > 2 * math.pi * (1 + 1e-6):
            raise ValueError(f"{self.width} columns of {self.azimuth_step} rad exceed the circle")
        if self.width > WIDEST_GRID:
            raise ValueError(f"a grid has at most {WIDEST_GRID} columns, got {self.width}")
        # Centres may lie on the poles; cells beyond them are cut off.
        last = self.first_elevation + (self.height - 1) * self.elevation_step
        if self.first_elevation < -math.pi / 2 - 1e-6 or last > math.pi / 2 + 1e-6:
            raise ValueError(
                f"elevations run from {self.first_elevation:g} to {last:g} rad; a sphere ends at "
                "+-pi/2"
            )

    @property
    def periodic(self) -> bool:
        """Whether the columns close the circle, so that footprints wrap in azimuth."""
        # A millionth of a radian: steps that a file has rounded still close the circle.
        return abs(self.width * self.azimuth_step - 2 * math.pi) < 1e-6

    @property
    def per_turn(self) -> float:
        """Columns in a full circle: the width where they close it, if only nearly;
        as in csrc/pixels.h.
        """
        return float(self.width) if self.periodic else 2 * math.pi / self.azimuth_step

    def elevations(self) -> Tensor:
        """Return row centres (H,) float64 [rad]."""
        return self.first_elevation + self.elevation_step * torch.arange(
            self.height, dtype=torch.float64
        )

    def azimuths(self) -> Tensor:
        """Return column centres (W,) float64 [rad].

        >>> SphereGrid.hemisphere(2, 4).azimuths().rad2deg()
        tensor([  0.,  90., 180., 270.], dtype=torch.float64)
        """
        return self.first_azimuth + self.azimuth_step * torch.arange(
            self.width, dtype=torch.float64
        )

    def directions(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return unit vectors of the pixel centres (H, W, 3), receiver frame.

        >>> SphereGrid.hemisphere(2, 4).directions().shape
        torch.Size([2, 4, 3])
        """
        elevation, azimuth = self.elevations()[:, None], self.azimuths()[None, :]
        level, upright = elevation.cos(), elevation.sin().expand(self.height, self.width)
        return torch.stack([level * azimuth.cos(), level * azimuth.sin(), upright], dim=-1).to(
            dtype
        )

    def solid_angles(self) -> Tensor:
        """Return the solid angle of each pixel (H, W) float64 [sr]; cells are cut off at the poles.

        >>> round(float(SphereGrid.full_sphere(90, 180).solid_angles().sum()) / math.pi, 6)
        4.0
        """
        elevation, half = self.elevations(), self.elevation_step / 2
        upper = (elevation + half).clamp(-math.pi / 2, math.pi / 2).sin()
        lower = (elevation - half).clamp(-math.pi / 2, math.pi / 2).sin()
        # The integral of cos(elevation) over a cell is a difference of sines,
        # without approximation.
        return ((upper - lower) * self.azimuth_step)[:, None].expand(self.height, self.width)

    def edges(self) -> tuple[float, float, float, float]:
        """Return least and largest azimuth, least and largest elevation
        of the pixels' edges [degrees].

        >>> tuple(round(edge, 3) for edge in SphereGrid.hemisphere(90, 360).edges())
        (-0.5, 359.5, -0.5, 89.5)
        """
        across, up = math.degrees(self.azimuth_step), math.degrees(self.elevation_step)
        first_edge, low = (
            math.degrees(self.first_azimuth) - across / 2,
            math.degrees(self.first_elevation) - up / 2,
        )
        return first_edge, first_edge + self.width * across, low, low + self.height * up

    @staticmethod
    def hemisphere(height: int = 90, width: int = 360) -> SphereGrid:
        """Return the RFID release's grid: row i is i steps above the horizon,
        column j is at j of azimuth.
        """
        return SphereGrid(height, width, 0.0, 0.0, math.pi / 2 / height, 2 * math.pi / width)

    @staticmethod
    def full_sphere(height: int = 180, width: int = 360) -> SphereGrid:
        """Return all directions; row centres half a step from the poles, column 0 at azimuth 0.

        >>> SphereGrid.full_sphere(2, 4).elevations().rad2deg()
        tensor([-45.,  45.], dtype=torch.float64)
        """
        step = math.pi / height
        return SphereGrid(height, width, -math.pi / 2 + step / 2, 0.0, step, 2 * math.pi / width)

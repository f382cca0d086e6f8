"""SwiftWRF: planar Gaussians on the spectrum itself, deformed by a small network,
summed in any order.

M. Liu, C. Zhang, Q. Yang, Y. Cao, Y. Xu, Y. Xu, S. Sun, M. Dai, Y. Guan, "Deformable 2D Gaussian
Splatting for Efficient Wireless Radiance Field Rendering" (SwiftWRF), 2025.

Kept: two-dimensional Gaussians without depth, a plain sum instead of compositing, one small network
from (Gaussian, position of the moving end) to changes of centre, shape and strength. Left out: the
two stages with annealed smoothing, the residual scheme between groups of spectra, complex signals
in two channels. The Gaussians lie on the unit sphere around the receiver rather than in the image
plane, so that the seam in azimuth closes; the plain sum is our compositing in the limit of
vanishing opacity, without occlusion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from gsparc.data.query import Query
from gsparc.data.site_objects import GaussianCloud
from gsparc.data.target import Kind
from gsparc.models.peers.gaussians import (
    MOST_STRETCH,
    SHIFT,
    Deformation,
    DeformedPeer,
    GaussianNetwork,
    render_each,
)
from gsparc.models.peers.trained import DIRECTIONS, KnownSite
from gsparc.ops import Cutoff, Pose, SphereGrid

CHANGES = (2, 2, 1, 1)  # centre, log of the two widths, angle, strength
THIN = 1e-3  # opacity of every Gaussian; a hundred on top of each other lose a twentieth on average
CUTOFF = Cutoff(3e-3, relative=True)
FLAT = 1e-4  # [m] of the third axis, at a metre


class PlanarGaussians(GaussianNetwork):
    """N Gaussians on the sphere; each moves and turns in its own tangent plane."""

    base: Tensor
    axes: Tensor
    frames: Tensor

    def __init__(self, scene: KnownSite, settings: DeformedPeer) -> None:
        super().__init__(scene, settings.count, settings.ssim_weight)
        assert scene.site.grid is not None
        self.grid, count = scene.site.grid, settings.count
        base, axes = sphere_lattice(self.grid, count)
        self.register_buffer("base", base)
        self.register_buffer("axes", axes)
        self.register_buffer("frames", frame_quaternions(axes, base))
        spacing = math.sqrt(float(self.grid.solid_angles().sum()) / count)
        self.centres = nn.Parameter(torch.zeros(count, 2))
        self.log_widths = nn.Parameter(torch.full((count, 2), math.log(spacing / 2)))
        self.angles = nn.Parameter(torch.zeros(count))
        self.strengths = nn.Parameter(torch.full((count,), 0.2))
        self.deformation = Deformation(DIRECTIONS, scene.box, sum(CHANGES), settings)

    def forward(self, query: Query) -> Tensor:
        """Return spectra (B, H, W)."""
        move, stretch, turn, light = self._changes_at(query)
        moved = self.centres + SHIFT * move
        directions = self.base + (moved.unsqueeze(-2) @ self.axes).squeeze(-2)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        widths = (self.log_widths + stretch.clamp(-MOST_STRETCH, MOST_STRETCH)).exp()
        flat = torch.full_like(widths[..., :1], FLAT)
        angle = (self.angles.unsqueeze(-1) + turn) / 2
        batch = len(moved)
        quats = turn_about_normal(self.frames, angle)
        opacities = widths.new_full((batch, len(self.base)), THIN)
        geometry = (directions, quats, torch.cat([widths, flat], -1), opacities)
        # The rasterizer multiplies by the opacity again:
        # what is left is the plain sum of strengths.
        strength = (self.strengths.unsqueeze(-1) + light) / THIN
        here = torch.zeros_like(self.base[0])
        image = render_each(
            geometry, strength, Pose.identity(here), self.grid, cutoff=CUTOFF, compensate=False
        )
        return image.squeeze(1)

    def _changes_at(self, query: Query) -> tuple[Tensor, ...]:
        return self.deformation(self.base, self.scene.site.moving(query.tx, query.rx)).split(
            CHANGES, -1
        )

    def emit(self, query: Query) -> Tensor:
        """See `GaussianNetwork`."""
        return self.strengths + self._changes_at(query)[-1][0, :, 0]

    def to_cloud(self, strengths: Tensor) -> GaussianCloud:
        """Return them a metre from the receiver, not yet moved; opacities are strengths:
        nothing is hidden.

        Raises:
            ValueError: the receiver moves: they are directions, and lie nowhere.
        """
        receiver = self.scene.receiver
        if receiver is None:
            raise ValueError("Gaussians of directions around a receiver that moves lie nowhere")
        towards = self.base + (self.centres.unsqueeze(-2) @ self.axes).squeeze(-2)
        means = (
            receiver.position + towards / towards.norm(dim=-1, keepdim=True) @ receiver.rotation.mT
        )
        turned = turn_about_normal(self.frames, self.angles[None, :, None] / 2)[0].numpy()
        rotation = Rotation.from_matrix(receiver.rotation.numpy())
        quats = rotation * Rotation.from_quat(turned, scalar_first=True)
        widths = self.log_widths.exp().double().numpy()
        return GaussianCloud(
            means.double().numpy(),
            np.column_stack([widths, np.full(len(widths), FLAT)]),
            quats.as_quat(scalar_first=True),
            strengths.double().clamp(0, 1).numpy(),
            strengths.double().numpy(),
            "emission of a Gaussian",
        )


@dataclass(eq=False, kw_only=True)
class SwiftWRF(DeformedPeer):
    """Spectra; settings as of `DeformedPeer`."""

    usual_steps: ClassVar[dict[Kind, int]] = {"spectrum": 1_935}
    rates: ClassVar[dict[str, float]] = {"centres": 2e-3, "strengths": 1e-2}
    makes = PlanarGaussians
    name: str = "swiftwrf"
    count: int = 300
    rate: float = 5e-3


def sphere_lattice(grid: SphereGrid, count: int) -> tuple[Tensor, Tensor]:
    """Return `count` even directions (N, 3) over the grid's part of a sphere,
    and tangents (N, 2, 3).
    """
    low = grid.first_elevation - grid.elevation_step / 2
    high = grid.first_elevation + (grid.height - 0.5) * grid.elevation_step
    step = torch.arange(count) + 0.5
    bottom, top = math.sin(max(low, -math.pi / 2)), math.sin(min(high, math.pi / 2))
    # Equal steps of z cut the sphere into equal areas.
    z = bottom + (top - bottom) * step / count
    # Turns by the golden ratio: a Fibonacci lattice, even at any count.
    turns = torch.remainder(step * (math.sqrt(5) - 1) / 2, 1.0)
    azimuth = grid.first_azimuth + turns * grid.width * grid.azimuth_step
    horizontal = (1 - z**2).clamp_min(0).sqrt()
    base = torch.stack([horizontal * azimuth.cos(), horizontal * azimuth.sin(), z], -1)
    east = torch.stack([-azimuth.sin(), azimuth.cos(), torch.zeros_like(azimuth)], -1)
    return base, torch.stack([east, torch.linalg.cross(base, east)], 1)


def frame_quaternions(axes: Tensor, normal: Tensor) -> Tensor:
    """Return rotations (N, 4) w x y z whose columns are two tangents (N, 2, 3)
    and the normal (N, 3).
    """
    columns = torch.cat([axes, normal.unsqueeze(1)], 1).mT
    return torch.from_numpy(
        Rotation.from_matrix(columns.numpy()).as_quat(scalar_first=True)
    ).float()


def turn_about_normal(frame: Tensor, half: Tensor) -> Tensor:
    """Return frames (N, 4) turned about their own third axis by twice `half` (B, N, 1) [rad]:
    (B, N, 4).
    """
    w, x, y, z = frame.unsqueeze(-1).unbind(-2)
    c, s = half.cos(), half.sin()
    return torch.cat([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], -1)

"""The Gaussian field: where radio energy comes from, as N anisotropic 3D Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.base.limits import POSITIVE, SHARE, Checked, internal, number, or_null, setting, whole
from gsparc.data.site_objects import GaussianCloud
from gsparc.ops.geometry import Gaussians

FLAT = 0.01  # [m], least extent of a box when Gaussians are sized to fill it


@dataclass(frozen=True)
class FieldSettings(Checked):
    """Size and initial state of the field.

    Attributes:
        count: initial number of Gaussians N.
        placement: `uniform` in the scene box enlarged by `margin` (the paper), `grid`, every
            `spacing` there (the authors' program), or `sphere`: evenly spread directions around the
            static receiver at distances between `near` and `far`. `auto` is settled by the group
            `init` (`gsparc.models.splat.auto_settings`).
        margin: enlargement of the box on each side [m].
        spacing: of `grid` [m], which makes as many Gaussians as fit, whatever `count`.
        near, far: range of distances of `sphere` [m].
        opacity: initial opacity in (0, 1).
        scale: initial standard deviation [m]; null takes the spacing between neighbours.
    """

    count: int = setting(500, whole(0))
    placement: Literal["auto", "uniform", "grid", "sphere"] = internal("auto")
    margin: float = setting(2.0, number(0))
    spacing: float = setting(0.3, POSITIVE)
    near: float = setting(1.0, number(0))
    far: float = setting(6.0, POSITIVE)
    opacity: float = setting(0.3, SHARE)
    scale: float | None = setting(None, or_null(POSITIVE))


class GaussianField(nn.Module):
    """Geometry and opacity of N Gaussians, in unconstrained form, with permanent ids.

    Attributes:
        means: (N, 3) [m], local world frame.
        log_scales: (N, 3), log of the standard deviations [m].
        quats: (N, 4), (w, x, y, z), any length but zero.
        opacity_logits: (N,).
        ids: (N,) int64, permanent: ties in depth are ordered by them.
        next_id: () int64, the first id never used.
        version: () int64, counts every edit of the parameters: frozen plans check it.
    """

    per_gaussian = True
    ids: Tensor
    next_id: Tensor
    version: Tensor

    def __init__(self, means: Tensor, scales: Tensor, opacity: float) -> None:
        super().__init__()
        count = len(means)
        self.means = nn.Parameter(means.float())
        self.log_scales = nn.Parameter(scales.float().log())
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1))
        self.opacity_logits = nn.Parameter(torch.full((count,), math.log(opacity / (1 - opacity))))
        self.register_buffer("ids", torch.arange(count))
        self.register_buffer("next_id", torch.tensor(count))
        self.register_buffer("version", torch.tensor(0))

    def __len__(self) -> int:
        return len(self.means)

    def geometry(self) -> Gaussians:
        """Return the Gaussians as the rasterizer takes them."""
        return Gaussians(self.means, self.quats, self.scales, self.opacities)

    @torch.no_grad()
    def to_cloud(self, strengths: Tensor, label: str) -> GaussianCloud:
        """Return what a picture or a file needs, with what each emits (N,),
        in the unit of `label`.
        """
        means, quats, scales, opacities = (part.double().numpy() for part in self.geometry())
        quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        return GaussianCloud(means, scales, quats, opacities, strengths.double().numpy(), label)

    @property
    def scales(self) -> Tensor:
        """Standard deviations (N, 3) [m]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities (N,) in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)


MOST_IN_GRID = 1_000_000  # Gaussians; networks of more need gigabytes


def check_grid(counts: Tensor, spacing: float) -> None:
    """Raise `ValueError`, which says what to set, where a grid of counts (3,)
    has more than a million.
    """
    if (total := int(counts.prod())) > MOST_IN_GRID:
        raise ValueError(
            f"model.field.spacing={spacing:g} m makes {total:,} Gaussians of this box; at most "
            f"{MOST_IN_GRID:,}: raise model.field.spacing"
        )


def create_field(
    settings: FieldSettings, box: Tensor, receiver: Tensor | None, rotation: Tensor | None
) -> GaussianField:
    """Return a field before training.

    Args:
        settings: size and initial state.
        box: (2, 3) [m], scene box, local frame.
        receiver: (3,) [m], the static receiver; None when it moves (then `sphere` is refused).
        rotation: (3, 3), its local-to-world rotation.

    Raises:
        ValueError: `sphere` without a static receiver, or nothing settled.
    """
    count = settings.count
    if settings.placement == "grid":
        low, high = box[0] - settings.margin, box[1] + settings.margin
        counts = ((high - low) / settings.spacing).long().clamp_min(1)
        check_grid(counts, settings.spacing)
        axes = [
            torch.linspace(float(a), float(b), int(n))
            for a, b, n in zip(low, high, counts, strict=True)
        ]
        means = torch.cartesian_prod(*axes)
        scales = torch.full((len(means), 3), float(settings.scale or settings.spacing))
        return GaussianField(means, scales, settings.opacity)
    if settings.placement == "uniform":
        low, high = box[0] - settings.margin, box[1] + settings.margin
        means = low + (high - low) * torch.rand(count, 3)
        volume = (high - low).clamp_min(FLAT).prod()  # positions in one plane span none
        spacing = (volume / max(count, 1)) ** (1 / 3)
        scales = torch.full((count, 3), float(settings.scale or spacing / 2))
        return GaussianField(means, scales, settings.opacity)
    if settings.placement != "sphere":
        raise ValueError(
            f"placement={settings.placement!r} is not settled: choose uniform, grid or sphere"
        )
    if receiver is None or rotation is None:
        raise ValueError("init=sphere needs a static receiver; here it moves: use init=uniform")
    step = torch.arange(count) + 0.5
    height = step / count  # equal areas on the upper hemisphere
    azimuth = math.pi * (1 + 5**0.5) * step  # golden angle: a Fibonacci lattice
    horizontal = (1 - height**2).sqrt()
    directions = torch.stack([horizontal * azimuth.cos(), horizontal * azimuth.sin(), height], -1)
    distance = settings.near + (settings.far - settings.near) * torch.rand(count, 1)
    means = receiver.float() + distance * directions @ rotation.float().T
    angle = math.sqrt(2 * math.pi / max(count, 1))  # [rad] between neighbours
    scales = (
        settings.scale * torch.ones(count, 3)
        if settings.scale
        else (distance * angle).expand(-1, 3)
    )
    return GaussianField(means, scales, settings.opacity)

"""Gaussians of a peer: their start, how they are rendered, and what they are for a picture."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from gsparc.data.site_objects import GaussianCloud
from gsparc.field.gaussians import FieldSettings, GaussianField, initial_field
from gsparc.field.model import FULL_SPHERE_ROWS
from gsparc.models.peers.network import Network, Scene
from gsparc.models.peers.trained import TrainedPeer
from gsparc.ops import Cutoff, Pose, SphereGrid, rasterize

MARGIN = 2.0  # [m] around the moving end's box
OPACITY = 0.3
GEOMETRY_RATES = {  # learning rates of a `GaussianField` called `field`
    "field.means": 2e-3, "field.log_scales": 5e-3, "field.quats": 1e-3, "field.opacity_logits": 1e-2,
}  # fmt: skip


class GaussianPeer(TrainedPeer):
    """A peer whose network is a `GaussianNetwork`."""

    has_gaussians = True

    @torch.no_grad()
    def gaussians(self, tx: Tensor, rx: Pose) -> GaussianCloud:
        """See `HasGaussians`."""
        network = self.fitted()
        assert isinstance(network, GaussianNetwork)
        emitted = [
            network.emitted(tx[i : i + 1], rx[i : i + 1] if rx.batched else rx) for i in range(len(tx))
        ]
        return network.cloud(torch.stack(emitted).square().mean(0).sqrt())


class GaussianNetwork(Network):
    """Renders Gaussians that lie in `field`."""

    field: GaussianField

    def emitted(self, tx: Tensor, rx: Pose) -> Tensor:
        """What each Gaussian emits (N,) for one position (1, 3)."""
        raise NotImplementedError

    def cloud(self, strengths: Tensor) -> GaussianCloud:
        """The Gaussians, with what each emits (N,)."""
        return self.field.cloud(strengths, "emission of a Gaussian")


def gaussians_of(scene: Scene, count: int) -> GaussianField:
    """All around a static receiver between 1 and 6 m; for a moving one uniform in its box and 2 m around."""
    static = scene.receiver
    place, turn = (None, None) if static is None else (static.position, static.rotation)
    init: Literal["uniform", "sphere"] = "uniform" if static is None else "sphere"
    settings = FieldSettings(count, init, margin=MARGIN, opacity=OPACITY)
    return initial_field(settings, scene.box, place, turn)


def rendering_of(scene: Scene) -> tuple[SphereGrid, dict[str, Any]]:
    """Grid and cut-off: spectra bring their grid; channels see the full sphere, with relative cut-offs."""
    grid = scene.site.grid or SphereGrid.full_sphere(FULL_SPHERE_ROWS, 2 * FULL_SPHERE_ROWS)
    return grid, {} if scene.site.kind == "spectrum" else {"cutoff": Cutoff(1e-3, relative=True)}


def render_each(
    geometry: tuple[Tensor, Tensor, Tensor, Tensor],
    features: Tensor,
    pose: Pose,
    grid: SphereGrid,
    **options: Any,
) -> Tensor:
    """Images of samples with different Gaussians each, one plan per sample.

    Args:
        geometry: means (B, N, 3), quaternions (B, N, 4), scales (B, N, 3), opacities (B, N).
        features: (B, N, C).
        pose: one shared or B.
        grid, **options: see `gsparc.ops.rasterize`.

    Returns:
        (B, C, H, W).
    """
    images = [
        rasterize(*one, feature, pose[i] if pose.batched else pose, grid, **options).image[0]  # type: ignore
        for i, (*one, feature) in enumerate(zip(*geometry, features, strict=True))
    ]
    return torch.stack(images)

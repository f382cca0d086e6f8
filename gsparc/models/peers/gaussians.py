"""Gaussians of a peer: their start, what changes them, how they are rendered,
what they are for a picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from gsparc.data.query import Query
from gsparc.data.site_objects import GaussianCloud
from gsparc.field.encoding import EncodingSettings, PositionEncoding
from gsparc.field.gaussians import FieldSettings, GaussianField, create_field
from gsparc.field.losses import LossSettings
from gsparc.field.model import FULL_SPHERE_ROWS, RasterSettings
from gsparc.models.peers.trained import KnownSite, Network, TrainedPeer, perceptron
from gsparc.ops import Cutoff, Pose, SphereGrid, rasterize

SHIFT = 0.1  # [m], of directions [rad], that a place moves by per unit of the network's output
# Of a log scale, a factor of 20 either way: exp of what a network says has no bound
MOST_STRETCH = 3.0
GEOMETRY_RATES = {  # learning rates of a `GaussianField` called `field`
    "field.means": 2e-3,
    "field.log_scales": 5e-3,
    "field.quats": 1e-3,
    "field.opacity_logits": 1e-2,
}


class GaussianPeer(TrainedPeer):
    """A peer whose network is a `GaussianNetwork`."""

    has_gaussians = True

    @torch.no_grad()
    def gaussians(self, query: Query) -> GaussianCloud:
        """See `HasGaussians`."""
        network = self.fitted()
        assert isinstance(network, GaussianNetwork)
        emitted = [network.emit(one) for one in query.split(1)]
        return network.to_cloud(torch.stack(emitted).square().mean(0).sqrt())


@dataclass(eq=False, kw_only=True)
class DeformedPeer(GaussianPeer):
    """Spectra of Gaussians that a network changes with the query.

    Args:
        count: Gaussians.
        width, depth: of the deforming network.
        octaves: of its Fourier features of places.
        ssim_weight: share of 1 - SSIM in the loss.
        others: see `TrainedPeer`.
    """

    count: int = FieldSettings().count
    width: int = 64
    depth: int = 3
    octaves: int = 5
    ssim_weight: float = LossSettings().ssim_weight


class GaussianNetwork(Network):
    """Renders Gaussians that lie in `field`; `ssim_weight` is the share of 1 - SSIM in the loss."""

    field: GaussianField

    def __init__(self, scene: KnownSite, count: int, ssim_weight: float) -> None:
        super().__init__(scene, count)
        self.losses = LossSettings(ssim_weight)

    def emit(self, query: Query) -> Tensor:
        """Return what each Gaussian emits (N,) for a query of one place."""
        raise NotImplementedError

    def to_cloud(self, strengths: Tensor) -> GaussianCloud:
        """Return the Gaussians, with what each emits (N,)."""
        return self.field.to_cloud(strengths, "emission of a Gaussian")


def initial_gaussians(scene: KnownSite, count: int) -> GaussianField:
    """Draw them where `FieldSettings` says: around a static receiver, else in and about the box."""
    static = scene.receiver
    place, turn = (None, None) if static is None else (static.position, static.rotation)
    init: Literal["uniform", "sphere"] = "uniform" if static is None else "sphere"
    return create_field(FieldSettings(count, init), scene.box, place, turn)


def rendering_options(scene: KnownSite) -> tuple[SphereGrid, dict[str, Any]]:
    """Return grid and cut-off: spectra bring their grid; channels see the sphere,
    cut off relatively.
    """
    grid = scene.site.grid or SphereGrid.full_sphere(FULL_SPHERE_ROWS, 2 * FULL_SPHERE_ROWS)
    least = RasterSettings().relative_cutoff
    return grid, {} if scene.site.target.is_image else {"cutoff": Cutoff(least, relative=True)}


def render_each(
    geometry: tuple[Tensor, Tensor, Tensor, Tensor],
    features: Tensor,
    pose: Pose,
    grid: SphereGrid,
    **options: Any,
) -> Tensor:
    """Return images of samples with different Gaussians each, one plan per sample.

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


class Deformation(nn.Module):
    """(place of a Gaussian, query) -> changes of its attributes; zero before training.

    Args:
        places: (2, 3) [m], box that the Gaussians start in.
        queries: (2, 3) [m], box of the moving end.
        outputs: numbers per Gaussian.
        settings: `width` and `depth` of the network, `octaves` of the Fourier features of both
            inputs.
    """

    def __init__(
        self, places: Tensor, queries: Tensor, outputs: int, settings: DeformedPeer
    ) -> None:
        super().__init__()
        width, encoding = settings.width, EncodingSettings("fourier", settings.octaves)
        self.place, self.query = (
            PositionEncoding(encoding, places),
            PositionEncoding(encoding, queries),
        )
        # The first layer is linear: its two halves are added instead
        # of writing every pair of inputs out.
        self.by_place = nn.Linear(self.place.width, width)
        self.by_query = nn.Linear(self.query.width, width)
        self.rest = perceptron(width, outputs, width, settings.depth - 1)
        for parameter in self.rest[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, places: Tensor, queries: Tensor) -> Tensor:
        """Return changes (B, N, outputs) of places (N, 3) [m] by queries (B, 3) [m]."""
        hidden = self.by_place(self.place(places)) + self.by_query(self.query(queries)).unsqueeze(1)
        return self.rest(torch.relu(hidden))

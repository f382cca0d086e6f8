"""What is timed: fields of a room filled with N Gaussians, seen by a receiver in its middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings, GaussianField
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings, RasterSettings
from gsparc.ops import Cutoff, Plan, Pose, SphereGrid, make_plan
from gsparc.ops.projection import Projection
from gsparc.ops.settings import IMAGE_CUTOFF

ROOM = np.array([[-8.0, -6.0, -3.0], [8.0, 6.0, 3.0]])  # [m]
# Images show the upper hemisphere; channels need all directions, at half the resolution.
GRID = SphereGrid.hemisphere()
CHANNEL_GRID = SphereGrid.full_sphere(90, 180)
CHANNEL_CUTOFF = Cutoff(1e-3, relative=True)
# Networks of the paper, 3-16-2, and larger ones on Fourier features, 63-32-2.
PAPER = EmissionSettings(EncodingSettings("raw"), 16, "sigmoid", log_distance=True, init_bias=0.0)
NETWORK = EmissionSettings(EncodingSettings("fourier"), 32, "sigmoid", log_distance=True, init_bias=0.0)
COMPLEX = 2  # real channels


class ComplexSpectra(GaussianModel):
    """A field that renders a complex image: two real channels."""

    @property
    def channels(self) -> int:
        """Real and imaginary part."""
        return COMPLEX


@dataclass(frozen=True)
class Scene:
    """A model of N Gaussians, its geometry as the rasterizer takes it, and places to ask at.

    Attributes:
        model: renders spectra of two channels; emission 3-16-2.
        geometry: means, quats, scales, opacities.
        features: (N, 2).
        projection: of all plans.
    """

    model: GaussianModel
    geometry: tuple[Tensor, Tensor, Tensor, Tensor]
    features: Tensor
    projection: Projection

    def __len__(self) -> int:
        return len(self.features)

    def plan(self, pose: Pose, *, channels: bool = False, backend: str | None = None) -> Plan:
        """Plan for spectra, or for the visibility that channels need."""
        grid, cutoff = (CHANNEL_GRID, CHANNEL_CUTOFF) if channels else (GRID, IMAGE_CUTOFF)
        return make_plan(
            *(*self.geometry, pose, grid), projection=self.projection, cutoff=cutoff, backend=backend
        )


def scene(
    count: int, projection: Projection, emission: EmissionSettings = PAPER, backend: str | None = None
) -> Scene:
    """Return a room of `count` Gaussians, half a spacing in size, of all shapes and opacities (seeded)."""
    # Seeded without touching the draws of whoever calls.
    with torch.random.fork_rng():
        # By its size, so that a scene is the same whichever were made before it.
        torch.manual_seed(count)
        settings = ModelSettings(
            FieldSettings(count=count, placement="uniform", margin=0.0), emission,
            AttenuationSettings(inverse_distance=True), raster=RasterSettings(projection, backend=backend),
        )  # fmt: skip
        model = ComplexSpectra(settings, _site())
        _scatter(model.gaussians)
        features = torch.rand(count, COMPLEX)
    means, quats, scales, opacities = (tensor.detach() for tensor in model.gaussians.geometry())
    return Scene(model, (means, quats, scales, opacities), features, projection)


def places(count: int) -> Tensor:
    """Return positions (count, 3) [m] around the middle of the room (seeded)."""
    draw = torch.Generator().manual_seed(count)
    return torch.randn(count, 3, generator=draw).clamp(-2, 2) * torch.tensor([1.0, 1.0, 0.3])


def receivers(count: int) -> Pose:
    """Return one pose per sample, upright."""
    return Pose.identity(places(count))


def receiver() -> Pose:
    """Return one pose for a whole batch."""
    return Pose.identity(places(1)[0])


@torch.no_grad()
def _scatter(field: GaussianField) -> None:
    field.log_scales.add_(torch.randn_like(field.log_scales), alpha=0.5)
    # Normal numbers, once they are normalised, are uniform rotations.
    field.quats.copy_(torch.randn_like(field.quats))
    # About 0.27 in the median, from nearly transparent to nearly opaque.
    field.opacity_logits.copy_(1.5 * torch.randn_like(field.opacity_logits) - 1)


def _site() -> Site:
    return Site(
        name="bench", kind="spectrum", static_end="tx", grid=GRID, array=None, carrier_hz=None,
        subcarriers_hz=None, origin=np.zeros(3), box=ROOM, moving_box=ROOM, sha256="",
    )  # fmt: skip

"""A position becomes a spectrum or a channel: field -> emission -> attenuation -> rasterizer."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gsparc import ops
from gsparc.base.limits import POSITIVE, Checked, or_null, setting
from gsparc.data.schema import Site
from gsparc.field.confidence import Confidence, ConfidenceSettings, ErrorModel
from gsparc.field.emission import Emission, EmissionSettings
from gsparc.field.encoding import PositionEncoding, Smoothness, unknown_share
from gsparc.field.gaussians import FieldSettings, GaussianField, create_field
from gsparc.field.response import ArrayResponse, ChannelResponse, MeanResponse, ResponseSettings
from gsparc.ops import Cutoff, FrozenPlan, Plan, Pose, Projection, Raster, SphereGrid
from gsparc.ops.geometry import Gaussians
from gsparc.ops.transforms import full_precision

FULL_SPHERE_ROWS = 90  # visibility of channels is measured on 2-degree pixels
DARK = 1e-20  # least squared modulus of a pixel


@dataclass(frozen=True)
class AttenuationSettings(Checked):
    """Distance law between transmitter and Gaussians.

    Attributes:
        inverse_distance: multiply emissions by gain / d_i (paper, eq. 3); off multiplies by 1.
        d_min: softening of d_i at the transmitter [m].
        d_ref: distance that counts as 1 [m]; null takes the distance between the static end and the
            middle of the moving end's box, because 1/d in metres caps the image.
        gain: initial gain.
        learn_gain: whether the gain is trained.
    """

    inverse_distance: bool = False
    d_min: float = setting(0.05, POSITIVE)
    d_ref: float | None = setting(None, or_null(POSITIVE))
    gain: float = setting(2.0, POSITIVE)
    learn_gain: bool = True


@dataclass(frozen=True)
class RasterSettings:
    """How footprints become pixels.

    Attributes:
        projection: see `gsparc.ops.settings.Optics`.
        low_pass: variance added to every footprint [px^2].
        compensate: keep a footprint's energy under the low-pass.
        alpha_cutoff: smallest alpha that counts in images.
        relative_cutoff: smallest share of a footprint's peak that counts in channels.
        backend: `reference`, `cpu`, `cuda`; null chooses by device.
    """

    projection: Projection = "tangent"
    low_pass: float = 0.3  # [px^2], as in 3D Gaussian splatting (Kerbl et al. 2023)
    compensate: bool = True
    alpha_cutoff: float = 1 / 255  # the least 8-bit step (Kerbl et al. 2023)
    relative_cutoff: float = 1e-3
    backend: str | None = None


@dataclass(frozen=True)
class ModelSettings:
    """Everything that shapes the model; see the parts."""

    field: FieldSettings = dataclasses.field(default_factory=FieldSettings)
    emission: EmissionSettings = dataclasses.field(default_factory=EmissionSettings)
    attenuation: AttenuationSettings = dataclasses.field(default_factory=AttenuationSettings)
    raster: RasterSettings = dataclasses.field(default_factory=RasterSettings)
    response: ResponseSettings = dataclasses.field(default_factory=ResponseSettings)
    confidence: ConfidenceSettings = dataclasses.field(default_factory=ConfidenceSettings)


@dataclass(frozen=True)
class Rendered:
    """A prediction and what it came from.

    Attributes:
        mean: (B, ...) in stored units.
        raster: of spectra; densification reads its gradients.
        unknown: (B,) in [0, 1], the share of the field's variance that training positions leave
            unknown; None where features do not tell.
        weights: (P, N), mean over directions of alpha T, of channels that are means of an image.
    """

    mean: Tensor
    raster: Raster | None
    unknown: Tensor | None = None
    weights: Tensor | None = None


class GaussianModel(nn.Module):
    """The trainable model for one site.

    Args:
        settings: all switches.
        site: what the dataset declares.
        receiver: the static receiver's pose, or None when it moves.
        transmitter: (3,) [m], the static transmitter, or None when it moves.
        prior: smoothness found on training data, for `encoding.kind=kernel`.
        shape: (antennas A, subcarriers K) of a channel; None for one of each.
    """

    def __init__(
        self,
        settings: ModelSettings,
        site: Site,
        receiver: Pose | None = None,
        transmitter: Tensor | None = None,
        prior: Smoothness | None = None,
        shape: tuple[int, int] | None = None,
    ) -> None:
        super().__init__()
        averaged = site.target.is_complex and settings.response.channel == "mean"
        signed = (site.target.is_complex and not averaged) or settings.response.array
        if signed and settings.emission.activation != "linear":
            reason = (
                "channels are signed"
                if site.target.is_complex
                else ("fields at an array are signed")
            )
            raise ValueError(
                f"model.emission.activation={settings.emission.activation}: {reason}, choose "
                "linear (or auto)"
            )
        self.settings = settings
        self.site = site
        self.shape = shape or (1, 1)
        box, query_box = torch.as_tensor(site.box).float(), torch.as_tensor(site.query_box)
        self.gaussians: GaussianField = create_field(
            settings.field,
            box,
            None if receiver is None else receiver.position,
            None if receiver is None else receiver.rotation,
        )
        encoding = PositionEncoding(settings.emission.encoding, query_box, prior)
        self.emission = Emission(settings.emission, len(self.gaussians), self.channels, encoding)
        self.confidence: Confidence | None = None
        self.error: ErrorModel | None = None  # in its place where the unknown share is known
        if settings.confidence.enabled and self.tells_unknown:
            self.error = ErrorModel()
        elif settings.confidence.enabled:
            of_position = PositionEncoding(settings.confidence.encoding, query_box, prior)
            self.confidence = Confidence(settings.confidence, of_position)
        static = receiver.position if receiver is not None else transmitter
        distance = None if static is None else float((static.float() - box.mean(0)).norm())
        law = settings.attenuation
        # A static end within 10 cm of the box's middle is no scale of distances.
        self.d_ref = law.d_ref or (distance if distance and distance > 0.1 else 1.0)
        # Without the law the gain is a parameter all the same, so that state dicts have one shape.
        law = law if law.inverse_distance else AttenuationSettings()
        self.log_gain = nn.Parameter(torch.tensor(math.log(law.gain)), requires_grad=law.learn_gain)
        self.response = self._response(*self.shape, transmitter)

    def _response(
        self, antennas: int, subcarriers: int, transmitter: Tensor | None
    ) -> ArrayResponse | ChannelResponse | MeanResponse | None:
        site, settings, means = self.site, self.settings.response, self.gaussians.means.detach()
        if settings.array:
            return ArrayResponse(site, settings.pattern)
        if not site.target.is_complex:
            return None
        if settings.channel == "mean":
            return MeanResponse(antennas, subcarriers)
        middle = torch.as_tensor(site.box).float().mean(0)
        lengths = (means - middle).norm(dim=1)
        if transmitter is not None:
            lengths = lengths + (means - transmitter.float()).norm(dim=1)
        tones = None if site.subcarriers_hz is None else torch.as_tensor(site.subcarriers_hz)
        return ChannelResponse(antennas, subcarriers, tones, lengths)

    @property
    def channels(self) -> int:
        """Real outputs of each emission network: one power, one complex gain,
        or one of each channel.
        """
        settings = self.settings.response
        if self.site.target.is_complex and settings.channel == "mean":
            return 2 * math.prod(self.shape)
        complex_image = self.site.target.is_image and settings.image != "power"
        return 2 if settings.array or complex_image else self.site.target.numbers

    @property
    def tells_unknown(self) -> bool:
        """Whether the emission's features tell what training positions leave unknown."""
        return self.site.target.is_image and self.emission.encoding.tells_share

    @full_precision
    def unknown_shares(self, tx: Tensor, rx: Pose) -> Tensor | None:
        """Return unknown shares f^2 (B,) of the field's variance;
        None where features do not tell.
        """
        if not self.tells_unknown:
            return None
        return unknown_share(self.emission.encoding(self.site.moving(tx, rx)))

    @full_precision  # a kernel expansion cancels: half precision costs 8 dB
    def emissions(self, tx: Tensor, rx: Pose) -> Tensor:
        """Return attenuated emissions a_i s_i (B, N, C): tx (B, 3) [m], one or B receiver poses."""
        distance = self.relative_distances(tx)
        emitted = self.emission(self.site.moving(tx, rx), distance)
        if self.site.target.is_image and self.settings.response.image == "real":
            emitted = emitted[..., :1]  # nothing reads the imaginary part
        attenuation = self.attenuation(distance)
        return emitted if attenuation is None else emitted * attenuation.unsqueeze(-1)

    def relative_distances(self, tx: Tensor) -> Tensor:
        """Return d_i / d_ref (B, N), softened at the transmitter: sqrt(|tx - mu_i|^2 + d_min^2)
        / d_ref.
        """
        # A sum over 3 is slow
        x, y, z = (tx[:, None, k] - self.gaussians.means[:, k] for k in range(3))
        # In place: fresh memory of megabytes costs more than the arithmetic.
        square = (x * x).addcmul_(y, y).addcmul_(z, z).add_(self.settings.attenuation.d_min**2)
        return square.mul_(1 / self.d_ref**2).sqrt_()

    def attenuation(self, distance: Tensor) -> Tensor | None:
        """Return a_i = gain / d_i (B, N), or None where the switch is off
        and nothing is to be computed.
        """
        return (
            self.log_gain.exp() / distance if self.settings.attenuation.inverse_distance else None
        )

    def forward(self, tx: Tensor, rx: Pose) -> Rendered:
        """Predict at tx (B, 3) [m] and one shared or B receiver poses."""
        features = self.emissions(tx, rx)
        if self.site.target.is_image:
            raster = self.rasterize(features, rx)
            unknown = self.unknown_shares(tx, rx)
            return Rendered(self.to_spectra(raster.image, unknown), raster, unknown)
        weights = ops.mean_weights(self.plan(rx), *self.gaussians.geometry())
        if isinstance(self.response, MeanResponse):
            if weights.mean.requires_grad:
                weights.mean.retain_grad()  # densification reads it
            return Rendered(self.response(weights.mean, features), None, weights=weights.mean)
        if self.response is None:
            return Rendered((weights.share.unsqueeze(-1) * features).sum(1), None)
        gains = torch.view_as_complex(features.contiguous())
        return Rendered(self.response(weights.share * gains), None)

    def to_spectra(self, image: Tensor, unknown: Tensor | None = None) -> Tensor:
        """Return spectra (B, H, W) of composited images (B, C, H, W) and unknown shares (B,)."""
        if isinstance(self.response, ArrayResponse):
            return self.response(image, unknown)
        if self.settings.response.image != "modulus":
            return image[:, 0]
        # `vector_norm` over two planes takes seven times as long; where nothing is,
        # the slope is 0, not NaN.
        return (image[:, 0].square() + image[:, 1].square()).clamp_min(DARK).sqrt()

    def raster_of_weights(self, rendered: Rendered, rx: Pose) -> Raster | None:
        """Return images whose means the channels are, after a backward pass;
        None where they are no means.

        `means2d` has the gradient that rendering all channels would have given: that of one image
        of what the loss asks of each Gaussian's weight.
        """
        if rendered.weights is None or rendered.weights.grad is None:
            return None
        with torch.enable_grad():
            raster = self.rasterize(rendered.weights.grad.unsqueeze(-1), rx, detached=True)
            raster.image.mean((-2, -1)).sum().backward()
        return raster

    def rasterize(self, features: Tensor, rx: Pose, detached: bool = False) -> Raster:
        """Return images of features (B, N, C) from one pose, or each from its own of B.

        Args:
            features, rx: of the image.
            detached: whether `means2d` alone takes a gradient, and no parameter.
        """
        geometry = self.gaussians.geometry()
        if detached:
            geometry = Gaussians(*(part.detach().requires_grad_() for part in geometry))
        return ops.rasterize(*geometry, features, rx, **self._raster_options())

    def plan(self, rx: Pose) -> Plan:
        """Return footprints and depth order from one pose, or from each of B."""
        return ops.make_plan(*self.gaussians.geometry(), rx, **self._raster_options())

    @property
    def grid(self) -> SphereGrid:
        """Of the site; else the directions that channels are seen from."""
        if self.site.grid is not None:
            return self.site.grid
        if self.settings.response.channel == "mean":  # the paper's hemisphere of one degree
            return SphereGrid.hemisphere(FULL_SPHERE_ROWS, 4 * FULL_SPHERE_ROWS)
        return SphereGrid.full_sphere(FULL_SPHERE_ROWS, 2 * FULL_SPHERE_ROWS)

    def _raster_options(self) -> dict[str, Any]:
        settings, image = self.settings.raster, self.site.target.is_image
        least = settings.alpha_cutoff if image else settings.relative_cutoff
        return {
            "grid": self.grid,
            "projection": settings.projection,
            "low_pass": settings.low_pass,
            "compensate": settings.compensate,
            "cutoff": Cutoff(least, relative=not image),
            "ids": self.gaussians.ids,
            "backend": settings.backend,
        }

    def freeze(self, rx: Pose) -> FrozenPlan:
        """Return the pixel x Gaussian matrix of a static receiver,
        valid until the field's next edit.
        """
        with torch.no_grad():
            return ops.freeze(
                self.plan(rx), *self.gaussians.geometry(), version=int(self.gaussians.version)
            )

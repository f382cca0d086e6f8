"""GSRF: complex-valued Gaussians whose radiance is a Fourier-Legendre series of direction.

K. Yang, G. Dong, S. Ji, W. Du, M. Srivastava, "GSRF: Complex-Valued 3D Gaussian Splatting for
Efficient Radio-Frequency Data Synthesis", NeurIPS 2025. Its forerunner RFSPM (K. Yang et al.,
"Scalable 3D Gaussian Splatting-Based RF Signal Spatial Propagation Modeling", 2025)
had a network per Gaussian instead.

Kept: complex radiance without any network, front-to-back compositing, magnitude of the complex sum,
a loss of absolute errors, SSIM and the frequency domain. Left out: the phase of the transmittance
(ours attenuates without a phase; radiances absorb it), adaptive density control, associated
Legendre functions (ours are products of polynomials and a Fourier series), orthographic splatting
onto a sphere of rays (our footprints lie on the tangent plane), spectra rendered about the
transmitter (ours are about the receiver).

Channels are an extension of ours: the distance to every Gaussian turns and fades its wave, and each
has a response per antenna and tone. The published task, an uplink channel at a latent position,
is another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from gsparc.data.query import Batch, Query
from gsparc.data.target import Kind
from gsparc.field.gaussians import FieldSettings
from gsparc.field.losses import task_loss
from gsparc.models.peers.gaussians import (
    GEOMETRY_RATES,
    GaussianNetwork,
    GaussianPeer,
    initial_gaussians,
    rendering_options,
)
from gsparc.models.peers.trained import KnownSite, smooth_root
from gsparc.ops import FrozenPlan, freeze, make_plan, mean_weights, rasterize


class ComplexGaussians(GaussianNetwork):
    """N Gaussians, each with K complex coefficients."""

    def __init__(self, scene: KnownSite, settings: GSRF) -> None:
        # Of what the base counts.
        super().__init__(
            scene, settings.count, settings.ssim_weight / (1 - settings.fourier_weight)
        )
        count, self.degree, self.order = settings.count, settings.degree, settings.order
        self.fourier_weight = settings.fourier_weight
        self.field = initial_gaussians(scene, count)
        self.grid, self.options = rendering_options(scene)
        self.coefficients = nn.Parameter(
            0.02 * torch.randn(count, count_terms(self.degree, self.order), 2)
        )
        with torch.no_grad():
            # The constant term: Gaussians begin by radiating alike to all sides.
            self.coefficients[:, 0, 0] += 0.3
        self.response: nn.Parameter | None = None
        if scene.site.target.is_complex:  # of each Gaussian at every antenna and tone
            response = torch.zeros(count, *scene.shape, 2)
            response[..., 0] = 1
            self.response = nn.Parameter(response)
        self._frozen: FrozenPlan | None = None

    def radiance_towards(self, query: Query) -> Tensor:
        """Return radiance (B, N, 2) of each Gaussian towards the moving end."""
        towards = self.scene.site.moving(query.tx, query.rx)[:, None] - self.field.means
        # [m]: 1 / distance grows without end at the moving end itself.
        distance = towards.norm(dim=-1, keepdim=True).clamp_min(0.05)
        series = fourier_legendre(towards / distance, self.degree, self.order)
        sent = torch.einsum("bnk,nkc->bnc", series, self.coefficients)
        if self.response is None:
            return sent
        # Channels of a moving end turn with its distance to every source.
        assert self.scene.site.wavelength is not None
        turns = torch.polar(1 / distance, -2 * torch.pi / self.scene.site.wavelength * distance)
        return torch.view_as_real(torch.view_as_complex(sent.contiguous()) * turns.squeeze(-1))

    def forward(self, query: Query) -> Tensor:
        """Return spectra (B, H, W) or channels (B, A, K)."""
        sent, geometry, rx = self.radiance_towards(query), self.field.geometry(), query.rx
        if self.response is not None:
            seen = mean_weights(
                make_plan(*geometry, rx, self.grid, **self.options), *geometry
            ).share
            arriving = seen * torch.view_as_complex(sent.contiguous())
            return torch.einsum("bn,nak->bak", arriving, torch.view_as_complex(self.response))
        return smooth_root(
            rasterize(*geometry, sent, rx, self.grid, **self.options).image.square().sum(1)
        )

    def emit(self, query: Query) -> Tensor:
        """See `GaussianNetwork`; of channels the root mean square over antennas and tones."""
        sent = self.radiance_towards(query)[0].norm(dim=1)
        return (
            sent
            if self.response is None
            else sent * self.response.square().sum(-1).mean((1, 2)).sqrt()
        )

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the base's, and for spectra the mean squared distance
        of the two-dimensional transforms.
        """
        seen = self(batch)
        plain = task_loss(seen, batch, self.losses, self.scene.site.target).mean()
        # A transform mixes all pixels, those that were not measured among them.
        if self.response is not None or batch.mask is not None or not self.fourier_weight:
            return plain
        difference = torch.fft.fft2(seen - batch.target, norm="ortho").abs().square().mean()
        return (1 - self.fourier_weight) * plain + self.fourier_weight * difference

    def train(self, mode: bool = True) -> ComplexGaussians:
        """Drop the frozen view, which further training makes stale."""
        self._frozen = None
        super().train(mode)
        return self

    @torch.no_grad()
    def rendered(self, query: Query) -> Tensor:
        """Render spectra or channels; a static receiver's view is frozen once."""
        if self.response is not None or query.rx.batched or self.training:
            return self(query)
        if self._frozen is None:
            geometry = self.field.geometry()
            plan = make_plan(*geometry, query.rx, self.grid, **self.options)
            self._frozen = freeze(plan, *geometry, version=0)
        return smooth_root(self._frozen.render(self.radiance_towards(query), 0).square().sum(1))


@dataclass(eq=False, kw_only=True)
class GSRF(GaussianPeer):
    """Spectra and channels.

    Args:
        count: Gaussians.
        degree, order: largest Legendre degree and Fourier order of the radiance.
        ssim_weight, fourier_weight: shares of SSIM and of the frequency domain in the loss
            (spectra).
        others: see `TrainedPeer`.
    """

    usual_steps: ClassVar[dict[Kind, int]] = {"spectrum": 1_429, "csi": 2_222}
    rates: ClassVar[dict[str, float]] = GEOMETRY_RATES
    makes = ComplexGaussians
    name: str = "gsrf"
    count: int = FieldSettings().count
    degree: int = 5
    order: int = 5
    ssim_weight: float = 0.37
    fourier_weight: float = 0.19
    rate: float = 8e-3


def count_terms(degree: int, order: int) -> int:
    """Return the number of terms of `fourier_legendre`."""
    return (degree + 1) * (2 * order + 1)


def fourier_legendre(directions: Tensor, degree: int, order: int) -> Tensor:
    """Return P_l(cos theta) times 1, cos(m phi), sin(m phi): unit vectors (..., 3) -> (..., terms).

    With complex coefficients these span the same functions as P_l(cos theta) exp(j m phi), |m| <=
    `order`, l <= `degree`; theta is measured from z.
    """
    x, y, z = directions.unbind(-1)
    legendre = [torch.ones_like(z), z]
    for n in range(1, degree):  # Bonnet's recursion
        legendre.append(((2 * n + 1) * z * legendre[n] - n * legendre[n - 1]) / (n + 1))
    azimuth = torch.atan2(y, x)
    waves = [torch.ones_like(azimuth)]
    for m in range(1, order + 1):
        waves += [torch.cos(m * azimuth), torch.sin(m * azimuth)]
    series = torch.stack(legendre[: degree + 1], -1).unsqueeze(-1) * torch.stack(
        waves, -1
    ).unsqueeze(-2)
    return series.flatten(-2)

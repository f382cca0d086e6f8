"""Frequency-embedded 3D Gaussians: a network of a Gaussian's place,
the query and the carrier changes them.

Z. Li, L. Yang, Y. Bian, H. Pan, Y. Fu, Y. Wang, Z. Chen, Y.-C. Chen, G. Xue, "Wideband RF Radiance
Field Modeling Using Frequency-embedded 3D Gaussian Splatting", NeurIPS 2025;
the authors' program (XFreq-GS).

Kept: complex signals of a harmonic series over directions; one network that scales amplitude,
attenuation and size, turns the phase, and scales and shifts the series' constant, pulled towards no
change; L1 and SSIM; one model of all carriers. Left out: codes of single Gaussians,
adaptive density control.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from gsparc.data.query import Batch, Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.data.target import Kind
from gsparc.field.losses import task_loss
from gsparc.models.peers.gaussians import (
    GEOMETRY_RATES,
    Deformation,
    DeformedPeer,
    GaussianNetwork,
    initial_gaussians,
    render_each,
    rendering_options,
)
from gsparc.models.peers.gsrf import count_terms, fourier_legendre
from gsparc.models.peers.trained import KnownSite, smooth_root
from gsparc.training.context import FitContext

# Amplitude, phase, attenuation, size, and of the series' constant scale and shift.
CHANGES = (1, 1, 1, 1, 2, 2)
MOST_CHANGE = (0.1, 0.1, 0.01)  # of the size, and of the constant's scale and shift
PULL = 5e-4  # weight of the squared changes in the loss
MOST_OPACITY = 0.999


class FrequencyEmbedded(GaussianNetwork):
    """Complex Gaussians and the network that changes them by carrier and query."""

    tuned: Tensor  # (stations,) octaves of each carrier above the lowest, as long as the box

    def __init__(self, scene: KnownSite, settings: Wideband) -> None:
        super().__init__(scene, settings.count, settings.ssim_weight)
        octaves = torch.from_numpy(scene.site.carriers).log2()
        if octaves.isnan().any():
            raise ValueError(f"{settings.name}: the dataset declares no carrier")
        self.grid, self.options = rendering_options(scene)
        self.field, self.degree = initial_gaussians(scene, settings.count), settings.degree
        self.series = nn.Parameter(
            0.1 * torch.randn(settings.count, count_terms(self.degree, self.degree), 2)
        )
        # As long as the box of places: features of both have the same octaves.
        span = (octaves.max() - octaves.min()).clamp_min(1.0)
        extent = (scene.box[1] - scene.box[0]).max()
        self.register_buffer("tuned", (extent * (octaves - octaves.min()) / span).float())
        box = torch.cat([scene.box, torch.stack([torch.zeros(1), extent[None]])], dim=1)
        places = torch.stack(self.field.means.detach().aminmax(dim=0))
        self.deformation = Deformation(places, box, sum(CHANGES), settings)

    def forward(self, query: Query) -> Tensor:
        """Return spectra (B, H, W)."""
        return self._render(query, self._changes_at(query))

    def _render(self, query: Query, changes: tuple[Tensor, ...]) -> Tensor:
        amplitude, phase, opacity, size = self._attributes(query, changes)
        count = len(query)
        geometry = (
            self.field.means.expand(count, -1, -1),
            self.field.quats.expand(count, -1, -1),
            self.field.log_scales.exp() * size.sqrt(),
            opacity,
        )
        signal = torch.stack([amplitude * phase.cos(), amplitude * phase.sin()], dim=-1)
        return smooth_root(
            render_each(geometry, signal, query.rx, self.grid, **self.options).square().sum(1)
        )

    def _changes_at(self, query: Query) -> tuple[Tensor, ...]:
        station = (
            torch.zeros(len(query), dtype=torch.long) if query.station is None else query.station
        )
        moving = self.scene.site.moving(query.tx, query.rx)
        return self.deformation(
            self.field.means, torch.cat([moving, self.tuned[station, None]], dim=1)
        ).split(CHANGES, -1)

    def _attributes(self, query: Query, changes: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Amplitude, phase and opacity (B, N), factor of the squared size (B, N, 1)."""
        amplitude, phase, attenuation, size, scale, shift = changes
        towards = self.scene.site.moving(query.tx, query.rx)[:, None] - self.field.means
        series = fourier_legendre(
            nn.functional.normalize(towards, dim=-1), self.degree, self.degree
        )
        whole = torch.einsum("bnk,nkc->bnc", series, self.series)
        constant = self.series[:, 0]
        raw = 0.5 + whole + MOST_CHANGE[1] * scale.tanh() * constant + MOST_CHANGE[2] * shift.tanh()
        strength = raw[..., 0].clamp_min(0) * (1 + amplitude[..., 0]).abs()
        turn = 2 * math.pi * (torch.sigmoid(raw[..., 1]) + phase[..., 0].tanh())
        opacity = torch.sigmoid(self.field.opacity_logits) * (1 + attenuation[..., 0]).abs()
        return strength, turn, opacity.clamp_max(MOST_OPACITY), 1 + MOST_CHANGE[0] * size.tanh()

    def emit(self, query: Query) -> Tensor:
        """See `GaussianNetwork`."""
        return self._attributes(query, self._changes_at(query))[0][0]

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the base's, and the pull of all changes towards none."""
        changes = self._changes_at(batch)
        pull = torch.stack([change.square().mean() for change in changes]).sum()
        plain = task_loss(self._render(batch, changes), batch, self.losses, self.scene.site.target)
        return plain.mean() + PULL * pull


@dataclass(eq=False, kw_only=True)
class Wideband(DeformedPeer):
    """Spectra, of all carriers in one model.

    Args:
        degree: largest degree and order of the series over directions.
        others: see `DeformedPeer`.
    """

    usual_steps: ClassVar[dict[Kind, int]] = {"spectrum": 2_700}
    rates: ClassVar[dict[str, float]] = {**GEOMETRY_RATES, "series": 2.5e-3}
    both_ends = True
    makes = FrequencyEmbedded
    name: str = "wideband"
    degree: int = 3
    ssim_weight: float = 0.4
    batch_size: int = 4

    def learns_jointly(self, site: Site) -> bool:
        """See `MethodFactory`."""
        return site.every_station.carrier_hz is not None

    def choose_stations(
        self, data: Measurements, fold: Fold, context: FitContext
    ) -> tuple[Literal["each", "together"], str]:
        """See `MethodFactory`."""
        return "together", "one network reads the carrier"

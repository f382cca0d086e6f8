"""WRF-GS+: 3D Gaussians that a network deforms for every position of the transmitter.

C. Wen, J. Tong, Y. Hu, Z. Lin, J. Zhang, "Neural Representation for Wireless Radiation Field
Reconstruction: A 3D Gaussian Splatting Approach" (WRF-GS and WRF-GS+), 2025.

Kept: a static part (the Gaussians) and a dynamic part (a network of a Gaussian's place and the
query) that moves, turns, stretches, fades and re-lights them (the authors' program neither moves
nor fades them); one projection per query; L1 and SSIM. Left out: adaptive density control, complex
signals in two channels, first Gaussians 20 m wide about the origin (ours start around the
receiver).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from gsparc.data.query import Query
from gsparc.data.target import Kind
from gsparc.models.peers.gaussians import (
    GEOMETRY_RATES,
    MOST_STRETCH,
    SHIFT,
    Deformation,
    DeformedPeer,
    GaussianNetwork,
    initial_gaussians,
    render_each,
    rendering_options,
)
from gsparc.models.peers.trained import KnownSite

CHANGES = (3, 4, 3, 1, 1)  # place, rotation, log scale, opacity logit, signal


class DeformedGaussians(GaussianNetwork):
    """Static Gaussians and the network that deforms them."""

    def __init__(self, scene: KnownSite, settings: DeformedPeer) -> None:
        super().__init__(scene, settings.count, settings.ssim_weight)
        self.grid, self.options = rendering_options(scene)
        self.field = initial_gaussians(scene, self.count)
        self.signals = nn.Parameter(torch.zeros(self.count))
        places = torch.stack(self.field.means.detach().aminmax(dim=0))
        self.deformation = Deformation(places, scene.box, sum(CHANGES), settings)

    def forward(self, query: Query) -> Tensor:
        """Return spectra (B, H, W)."""
        field = self.field
        place, turn, stretch, fade, light = self._changes_at(query)
        stretch = stretch.clamp(-MOST_STRETCH, MOST_STRETCH)
        geometry = (
            field.means + SHIFT * place,
            field.quats + turn,
            (field.log_scales + stretch).exp(),
            torch.sigmoid(field.opacity_logits + fade.squeeze(-1)),
        )
        signal = torch.sigmoid(self.signals.unsqueeze(-1) + light)
        return render_each(geometry, signal, query.rx, self.grid, **self.options).squeeze(1)

    def _changes_at(self, query: Query) -> tuple[Tensor, ...]:
        changes = self.deformation(self.field.means, self.scene.site.moving(query.tx, query.rx))
        return changes.split(CHANGES, -1)

    def emit(self, query: Query) -> Tensor:
        """See `GaussianNetwork`; these are drawn where they lie before they are moved."""
        return torch.sigmoid(self.signals + self._changes_at(query)[-1][0, :, 0])


@dataclass(eq=False, kw_only=True)
class WRFGSPlus(DeformedPeer):
    """Spectra; settings as of `DeformedPeer`."""

    usual_steps: ClassVar[dict[Kind, int]] = {"spectrum": 2_727}
    rates: ClassVar[dict[str, float]] = {**GEOMETRY_RATES, "signals": 1e-2}
    makes = DeformedGaussians
    name: str = "wrfgs"
    batch_size: int = 4

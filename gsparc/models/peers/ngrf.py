"""nGRF: channels as a direct complex sum over Gaussians, with no image in between.

M. Umer, M. A. Mohsin, A. Bilal, J. M. Cioffi,
"Neural Gaussian Radio Fields for Channel Estimation", 2025.

Kept: Gaussians in space as radiators with complex responses, summed as waves without occlusion:
h = sum_i g_i exp(-j k r_i) / r_i, r_i softened by the Gaussian's extent. Left out: the network that
gives the responses (ours are free numbers; a network that also knew the query would fit every
training sample and predict none), adaptive density control, polarised antenna patterns (one learned
response per antenna). Written from the published description; the authors' attributes may differ.
Spectra, which the paper does not predict, are what a declared static array makes of the same waves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from gsparc.data.query import Query
from gsparc.data.target import Kind
from gsparc.models.peers.trained import KnownSite, Network, TrainedPeer
from gsparc.physics.array_response import bartlett_spectrum, normalise_spectrum, steering_matrix
from gsparc.physics.waves import LIGHT

MARGIN = 3.0  # [m] around the moving end's box, where radiators start
TRANSMITTER_SPREAD = 0.05  # [m] of the one that starts at a known transmitter


class Radiators(Network):
    """N radiators; `ValueError` without a frequency, or for spectra without an array."""

    wavenumbers: Tensor
    steering: Tensor | None

    def __init__(self, scene: KnownSite, settings: NGRF) -> None:
        super().__init__(scene, settings.count)
        site, count, name, spectrum = (
            scene.site,
            self.count,
            settings.name,
            scene.site.target.is_image,
        )
        if site.subcarriers_hz is None and site.carrier_hz is None:
            raise ValueError(
                f"{name}: the dataset declares no frequency, waves have no phase without"
            )
        if spectrum and (site.array is None or scene.receiver is None):
            raise ValueError(f"{name}: spectra need a static receiver with a declared array")
        antennas, tones = (len(site.array), 1) if spectrum else scene.shape  # type: ignore[arg-type]
        low, high = scene.box[0] - MARGIN, scene.box[1] + MARGIN
        means = low + (high - low) * torch.rand(count, len(low))
        if site.static_end == "tx" and site.static_position is not None:
            means[0] = torch.from_numpy(
                site.static_position
            ) + TRANSMITTER_SPREAD * torch.randn_like(low)
        self.means = nn.Parameter(means)
        self.log_extents = nn.Parameter(torch.full((count,), math.log(0.05)))
        self.gains = nn.Parameter(torch.randn(count, 2) * scene.reach / math.sqrt(2 * count))
        response = torch.zeros(count, antennas, 2)
        response[..., 0] = 1
        matrix = None
        if spectrum:  # a Gaussian starts as a plane wave from where it stands
            receiver = scene.receiver
            assert receiver is not None and site.grid is not None and site.array is not None
            assert site.wavelength is not None
            matrix = steering_matrix(site.array, site.grid, site.wavelength).to(torch.complex64)
            heading = nn.functional.normalize(receiver.local(means), dim=-1)
            turns = heading @ torch.as_tensor(site.array).float().T / site.wavelength
            response = torch.view_as_real(torch.polar(torch.ones(()), 2 * math.pi * turns))
        self.register_buffer("steering", matrix, persistent=False)
        self.antennas = nn.Parameter(response)
        hertz = site.subcarriers_hz
        hertz = torch.as_tensor([site.carrier_hz] * tones if hertz is None else hertz)  # type: ignore
        self.register_buffer("wavenumbers", (2 * math.pi / LIGHT * hertz).float())  # type: ignore

    def forward(self, query: Query) -> Tensor:
        """Return channels (B, A, K) or spectra (B, H, W)."""
        moving = self.scene.site.moving(query.tx, query.rx)
        offset = moving[:, None] - self.means
        distance = (offset.square().sum(-1) + (2 * self.log_extents).exp()).sqrt()
        strength = torch.view_as_complex(self.gains) / distance
        waves = torch.polar(torch.ones(()), -distance.unsqueeze(-1) * self.wavenumbers)
        arriving = torch.view_as_complex(self.antennas).mT @ (strength.unsqueeze(-1) * waves)
        if self.steering is None:
            return arriving
        image = bartlett_spectrum(arriving[..., 0], self.steering)
        return normalise_spectrum(image, self.scene.site.normalisation).view(-1, *self.scene.shape)


@dataclass(eq=False, kw_only=True)
class NGRF(TrainedPeer):
    """Channels, and spectra of a static array.

    Args:
        count: Gaussians.
        others: see `TrainedPeer`.
    """

    usual_steps: ClassVar[dict[Kind, int]] = {"csi": 15_789, "spectrum": 3_000}
    rates: ClassVar[dict[str, float]] = {"means": 3e-3, "gains": 1e-2}
    makes = Radiators
    name: str = "ngrf"
    count: int = 30
    rate: float = 5e-3

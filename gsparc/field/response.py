"""From emissions of rasterized Gaussians to measurements: channels, an array's spectra.

Each response is one term of the model, with its own gradients; the model holds the one that site
and settings require.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from gsparc.base.limits import Checked, choice, internal, number, setting
from gsparc.data.schema import Site
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import (
    array_output,
    element_pattern,
    normalise_spectrum,
    steering_matrix,
)
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.physics.waves import LIGHT

SLOPE_ENDS = 1e-12  # of an unknown share: its square root has a finite slope above


@dataclass(frozen=True)
class ResponseSettings(Checked):
    """From rendered Gaussians to targets; a coherent term that is off is not computed.

    Attributes:
        array: spectra arise in the static array: complex emissions are composited per direction to
            z, the elements measure `h = A z`, and the spectrum is `sqrt(|A^H h|^2 + f^2 mean^2)`
            with the share f^2 of the field that training positions leave unknown; where emissions
            tell none (not started in closed form), `|A^H h|` normalised as the dataset is.
        pattern: element amplitude, cos^pattern of the angle off boresight; 0 is isotropic.
        image: what of an image is a spectrum: `power`, of one emission a Gaussian; of complex ones,
            `modulus` or `real` part.
        channel: `sources`, gains of Gaussians through their steering and delays
            (`ChannelResponse`); `mean`, the mean over all directions of an image of emissions,
            one a channel (paper, eq. 2).
    """

    array: bool = internal(False)
    pattern: float = setting(0.0, number(0))
    image: Literal["power", "modulus", "real"] = setting(
        "power", choice("power", "modulus", "real")
    )
    channel: Literal["sources", "mean"] = setting("sources", choice("sources", "mean"))


class MeanResponse(nn.Module):
    """Channels as means over directions of an image:
    `h = sum_i (mean_u alpha_i T_i) s_i` (paper, eq. 2).

    Args:
        antennas, subcarriers: A and K; emissions are A K complex numbers of each Gaussian.
    """

    def __init__(self, antennas: int, subcarriers: int) -> None:
        super().__init__()
        self.shape = antennas, subcarriers

    def forward(self, weights: Tensor, features: Tensor) -> Tensor:
        """Return channels (B, A, K) complex of weights (P, N), P of 1 or B,
        and emissions (B, N, 2 A K).
        """
        total = torch.bmm(weights.expand(len(features), -1).unsqueeze(1), features)
        return torch.view_as_complex(total.view(len(features), *self.shape, 2))


class ChannelResponse(nn.Module):
    """Factored channels: each Gaussian has a steering vector over antennas
    and a delay over subcarriers.

    `H = A diag(w g) F^T`: 2 A + 1 numbers per Gaussian however many channels there are, and one
    pass for all of them. Steering starts at one, delays at the initial path lengths.

    Args:
        antennas, subcarriers: A and K.
        tones_hz: (K,) frequencies; None when unknown, then an even comb is assumed.
        lengths: (N,) [m], initial path lengths.
    """

    per_gaussian = True
    numbers: Tensor

    def __init__(
        self, antennas: int, subcarriers: int, tones_hz: Tensor | None, lengths: Tensor
    ) -> None:
        super().__init__()
        self.subcarriers = subcarriers
        self.steering = nn.Parameter(torch.tensor([1.0, 0.0]).repeat(len(lengths), antennas, 1))
        numbers = torch.arange(subcarriers, dtype=torch.float64)
        band = None
        if tones_hz is not None and subcarriers > 1:
            band = float(tones_hz[-1] - tones_hz[0]) * subcarriers / (subcarriers - 1)
            numbers = (tones_hz - tones_hz[0]).double() / band * subcarriers
        numbers = numbers - numbers.mean()
        self.register_buffer("numbers", numbers, persistent=False)
        turns = lengths / LIGHT * band if band else torch.zeros_like(lengths)
        # In cells of 1 / bandwidth: a step of Adam then means the same on every band.
        self.delays = nn.Parameter(turns.float(), requires_grad=subcarriers > 1)

    def forward(self, weighted: Tensor) -> Tensor:
        """Return channels (B, A, K) complex of visible gains (B, N) complex."""
        delays = self.delays.double() / self.subcarriers  # in periods of the mean tone spacing
        phase = -2 * math.pi * torch.outer(delays, self.numbers).to(weighted.real.dtype)
        parts = {"bn": weighted, "na": torch.view_as_complex(self.steering)}
        parts["nk"] = torch.polar(torch.ones_like(phase), phase)
        # The longest last: PyTorch multiplies from left to right,
        # and stores the product of the first two.
        order = sorted(parts, key=lambda name: parts[name].numel())
        return torch.einsum(",".join(order) + "->bak", *(parts[name] for name in order))


class ArrayResponse(nn.Module):
    """Composited directional fields through a static array to the spectrum it reports.

    Args:
        site: spectra of a static array.
        pattern: exponent of the element's cosine.

    Raises:
        ValueError: the site's spectra have no array to go through.
    """

    matrix: Tensor
    pattern: Tensor | None

    def __init__(self, site: Site, pattern: float) -> None:
        super().__init__()
        if site.array_problem is not None:
            raise ValueError(f"model.response.array=true is not possible: {site.array_problem}")
        self.array, self.grid, self.wavelength = site.array_geometry()
        self.normalisation = site.normalisation
        matrix = steering_matrix(self.array, self.grid, self.wavelength).to(torch.complex64)
        self.register_buffer("matrix", matrix, persistent=False)
        elements = element_pattern(self.grid, pattern) if pattern else None
        self.register_buffer("pattern", elements, persistent=False)
        no_background = torch.zeros(self.grid.height, self.grid.width)
        self.renderer = SpectrumRenderer(self.array, self.grid, self.wavelength, no_background)

    def array_vectors(self, image: Tensor) -> Tensor:
        """Return array vectors h = A z (B, M) complex64 of composited fields (B, 2, H, W)
        per steradian.
        """
        waves = torch.complex(image[:, 0], image[:, 1])
        return array_output(waves, self.matrix, self.grid, self.pattern)

    @property
    def background(self) -> Tensor:
        """Mean spectrum (H, W), what an unknown field is expected to look like."""
        return self.renderer.square.sqrt()

    @background.setter
    def background(self, image: Tensor) -> None:
        self.renderer.square.copy_(image.square())

    def coarse_renderer(self, stride: int, grid: SphereGrid) -> SpectrumRenderer:
        """Return the renderer on `grid`, every `stride`-th row and column of its own."""
        return SpectrumRenderer(
            self.array, grid, self.wavelength, self.background[::stride, ::stride]
        )

    def spectra(self, vectors: Tensor, unknown: Tensor | None = None) -> Tensor:
        """Return published spectra (B, H, W) of array vectors (B, M) and unknown shares f^2 (B,),
        if any.

        Vectors beside a share have the scale of published spectra: the mean of an uncertain one has
        no maximum of 1 to be divided by.
        """
        if unknown is not None:
            share = unknown.clamp_min(SLOPE_ENDS).sqrt()
            return self.renderer(torch.cat([vectors, share[:, None].to(vectors.dtype)], 1))
        # No incoherent background
        inputs = torch.cat([vectors, torch.zeros_like(vectors[:, :1])], 1)
        # Scaled first: the slope is cut off below a fixed amplitude
        if self.normalisation != "none":
            inputs = inputs / torch.linalg.vector_norm(
                vectors.detach(), dim=1, keepdim=True
            ).clamp_min(1e-20)
        image = self.renderer(inputs).flatten(1)
        return normalise_spectrum(image, self.normalisation).unflatten(
            1, (self.grid.height, self.grid.width)
        )

    def forward(self, image: Tensor, unknown: Tensor | None = None) -> Tensor:
        """Return spectra (B, H, W) of composited fields (B, 2, H, W) and unknown shares (B,)."""
        return self.spectra(self.array_vectors(image), unknown)

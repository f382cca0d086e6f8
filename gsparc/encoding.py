"""How a position becomes the input of the emission and confidence networks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class EncodingSettings:
    """Choice of encoding.

    Attributes:
        kind: `raw` coordinates (the paper), `fourier` octaves along the axes, or `matern`: random Fourier
            features of a Matern-3/2 covariance, so that a linear read-out is a Gaussian process.
        octaves: number of octaves of `fourier`; the first has a period of twice the scene box.
        features: number of cosines of `matern`.
        length: correlation length of `matern` [m]; null means half a wavelength.
    """

    kind: Literal["raw", "fourier", "matern"] = "fourier"
    octaves: int = 5
    features: int = 64
    length: float | None = None


class PositionEncoding(nn.Module):
    """Encode local positions (B, 3) [m] as (B, width) float32 of order one.

    Args:
        settings: which encoding.
        box: (2, 3) [m], lower and upper corner of the moving end's box, local frame.
        wavelength: carrier wavelength [m], for the default correlation length.
        seed: of the random frequencies of `matern`.
    """

    centre: Tensor
    half_extent: Tensor
    frequencies: Tensor
    phases: Tensor

    def __init__(
        self, settings: EncodingSettings, box: Tensor, wavelength: float | None, seed: int = 0
    ) -> None:
        super().__init__()
        box = torch.as_tensor(box, dtype=torch.float64)
        extent = (box[1] - box[0]).max().clamp_min(1e-6)  # one scale for all axes keeps distances true
        self.settings = settings
        self.register_buffer("centre", box.mean(0).float())
        self.register_buffer("half_extent", (extent / 2).float())
        if settings.kind == "raw":
            frequencies, phases = torch.zeros(0, 3), torch.zeros(0)
        elif settings.kind == "fourier":
            octaves = math.pi * 2.0 ** torch.arange(settings.octaves)
            axes = (octaves[:, None, None] * torch.eye(3)).reshape(-1, 3)
            frequencies = axes.repeat(2, 1)
            phases = torch.cat([torch.zeros(len(axes)), torch.full((len(axes),), -math.pi / 2)])
        elif settings.kind == "matern":
            length = settings.length if settings.length is not None else (wavelength or float(extent) / 4) / 2
            frequencies = _matern_frequencies(settings.features, seed) * float(extent / 2) / length
            generator = torch.Generator().manual_seed(seed + 1)
            phases = 2 * math.pi * torch.rand(settings.features, generator=generator)
        else:
            raise ValueError(f"model.emission.encoding.kind={settings.kind!r}: choose raw, fourier or matern")
        self.register_buffer("frequencies", frequencies)
        self.register_buffer("phases", phases)

    @property
    def width(self) -> int:
        """Number of encoded values."""
        return 3 + len(self.frequencies) if self.settings.kind != "matern" else len(self.frequencies)

    def forward(self, position: Tensor) -> Tensor:
        """Encode (B, 3) [m] as (B, width)."""
        scaled = (position - self.centre) / self.half_extent
        waves = torch.cos(scaled @ self.frequencies.T + self.phases)
        return waves * math.sqrt(2) if self.settings.kind == "matern" else torch.cat([scaled, waves], dim=-1)


def _matern_frequencies(count: int, seed: int) -> Tensor:
    """Angular frequencies (count, 3) of a unit-length Matern-3/2 in 3D: its spectrum is a t with 3 dof."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, generator=generator)
    chi_square = torch.randn(count, 3, generator=generator).square().sum(-1, keepdim=True)
    return normal / (chi_square / 3).sqrt()

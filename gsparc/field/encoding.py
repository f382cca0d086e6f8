"""How a position becomes the input of the emission and confidence networks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from gsparc.base.limits import Checked, setting, whole
from gsparc.processes.features import Correlation, correlation, whitened_features

JITTER = 1e-5  # relative to the unit variance of the kernel: repeated positions stay invertible


@dataclass(frozen=True)
class EncodingSettings(Checked):
    """Choice of encoding.

    Attributes:
        kind: `raw` coordinates (the paper), `fourier` octaves along the axes, or `kernel`: whitened
            similarities to training positions, so that a linear read-out with independent weights
            is a Gaussian process of the emission.
        octaves: number of octaves of `fourier`; the period of the first is the longest side of the
            box.
        anchors: largest number of training positions of `kernel`.
    """

    kind: Literal["auto", "raw", "fourier", "kernel"] = "auto"
    octaves: int = setting(5, whole(0, 30))
    anchors: int = setting(1024, whole(1))


@dataclass(frozen=True)
class Smoothness:
    """How smoothly targets change with position: what leaving training data out found.

    Attributes:
        anchors: (M, 3) float32 [m], training positions.
        length: correlation length [m].
        noise: variance of the unexplained part relative to the signal's.
        kernel: of `correlation`.
        whitening: (M, M) float32 that counts the noise and all training rows in, of `whitened`: the
            features' squared length is then the share of the process that these rows tell. None:
            that of the anchors alone without noise, and nothing is known about the share.
    """

    anchors: Tensor
    length: float
    noise: float
    kernel: Correlation = "matern32"
    whitening: Tensor | None = None


class PositionEncoding(nn.Module):
    """Encode local positions (B, D) [m] as (B, width) float32 of order one.

    Args:
        settings: which encoding.
        box: (2, D) [m], lower and upper corner of the moving end's box, local frame; of both ends,
            D = 6.
        prior: needed by `kernel`.
    """

    centre: Tensor
    half_extent: Tensor
    frequencies: Tensor
    phases: Tensor
    anchors: Tensor
    whitening: Tensor
    tells_share = False  # whether the squared length of the features is a share that is known

    def __init__(
        self, settings: EncodingSettings, box: Tensor, prior: Smoothness | None = None
    ) -> None:
        super().__init__()
        box = torch.as_tensor(box, dtype=torch.float64)
        # One scale for all axes keeps distances true
        extent = (box[1] - box[0]).max().clamp_min(1e-6)
        self.settings = settings
        self.register_buffer("centre", box.mean(0).float())
        self.register_buffer("half_extent", (extent / 2).float())
        if settings.kind in ("raw", "fourier"):  # coordinates alone are those without octaves
            stored = settings.kind == "fourier"
            octaves = math.pi * 2.0 ** torch.arange(settings.octaves if stored else 0)
            axes = (octaves[:, None, None] * torch.eye(box.shape[1])).reshape(-1, box.shape[1])
            self.register_buffer("frequencies", axes.repeat(2, 1), persistent=stored)
            quarter = torch.full((len(axes),), -math.pi / 2)
            self.register_buffer(
                "phases", torch.cat([torch.zeros(len(axes)), quarter]), persistent=stored
            )
        elif settings.kind == "kernel":
            if prior is None:
                raise ValueError(
                    "model.emission.encoding.kind=kernel needs a prior learned from training "
                    "positions"
                )
            self.length, self.noise, self.kernel = prior.length, prior.noise, prior.kernel
            self.tells_share = prior.whitening is not None
            self.register_buffer("anchors", prior.anchors.float())
            arguments = (
                prior.anchors.double(),
                prior.length,
                JITTER,
                prior.kernel,
                len(prior.anchors),
            )
            whitening = prior.whitening
            if whitening is None:
                whitening = whitened_features(*arguments).whitening.float()
            # What the prior holds is stored with it.
            self.register_buffer("whitening", whitening, persistent=prior.whitening is None)
        else:
            raise ValueError(
                f"model.emission.encoding.kind={settings.kind!r}: choose raw, fourier or kernel"
            )

    @property
    def width(self) -> int:
        """Number of encoded values."""
        if self.settings.kind == "kernel":
            return self.whitening.shape[1]
        return len(self.centre) + len(self.frequencies)

    def forward(self, position: Tensor) -> Tensor:
        """Encode (B, D) [m] as (B, width)."""
        if self.settings.kind == "kernel":
            return correlation(position, self.anchors, self.length, self.kernel) @ self.whitening
        scaled = (position - self.centre) / self.half_extent
        return torch.cat([scaled, torch.cos(scaled @ self.frequencies.T + self.phases)], dim=-1)


def unknown_share(features: Tensor) -> Tensor:
    """Return posterior over prior variance (B,) in [0, 1] of a process:
    `1 - |phi|^2` of features (B, E).
    """
    return (1 - torch.linalg.vecdot(features, features)).clamp_(0, 1)

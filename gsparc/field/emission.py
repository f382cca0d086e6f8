"""Emission of each Gaussian towards the receiver: one small network per Gaussian,
evaluated together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from gsparc.base.limits import Checked, choice, number, setting, whole
from gsparc.field.encoding import EncodingSettings, PositionEncoding
from gsparc.ops.transforms import full_precision

ACTIVATIONS = ("auto", "sigmoid", "signed_sigmoid", "softplus", "linear")
LEAK = 0.01  # slope of `leaky_relu` below 0
EMISSION_FLOOR = 0.01  # inverting an activation stops short of its infinities


@dataclass(frozen=True)
class EmissionSettings(Checked):
    """Shape of the emission networks (paper: 3-16-2, raw coordinates).

    Attributes:
        encoding: how the moving end's position enters.
        hidden: hidden units; 0 makes the network linear in the encoding.
        activation: of the output: `sigmoid` (in (0, 1), carries the log-distance term),
            `signed_sigmoid` (twice that less 1, in (-1, 1)), `softplus` (powers without a ceiling)
            or `linear` (signed CSI).
        log_distance: subtract log d_i before the sigmoid (eq. 1 of the paper).
        init_scale: standard deviation of the last layer's initial weights.
        init_bias: initial bias of the output, in units of the activation's input; `auto` lets all
            Gaussians together start at unit power where they simply add up (RSSI), else 0.
        rectifier: of the hidden units: `relu`, or `leaky_relu` of slope .01 below 0.
    """

    encoding: EncodingSettings = field(default_factory=EncodingSettings)
    hidden: int = setting(0, whole(0))
    activation: Literal["auto", "sigmoid", "signed_sigmoid", "softplus", "linear"] = setting(
        "auto", choice(*ACTIVATIONS)
    )
    log_distance: bool = False
    init_scale: float = setting(0.1, number(0))
    init_bias: float | Literal["auto"] = "auto"
    rectifier: Literal["relu", "leaky_relu"] = setting("relu", choice("relu", "leaky_relu"))


class Emission(nn.Module):
    """N networks E -> hidden -> C; every weight has the Gaussian as its first axis.

    Args:
        settings: shape of the networks.
        count: number of Gaussians N.
        channels: real output channels C.
        encoding: encoder shared by all Gaussians.
    """

    per_gaussian = True  # every weight has one row per Gaussian; edits keep them together

    def __init__(
        self, settings: EmissionSettings, count: int, channels: int, encoding: PositionEncoding
    ) -> None:
        super().__init__()
        if settings.log_distance and settings.activation not in ("sigmoid", "signed_sigmoid"):
            raise ValueError(
                f"model.emission.log_distance=true needs activation=sigmoid or signed_sigmoid, got "
                f"{settings.activation!r}: an unbounded output has no logarithm to shift"
            )
        self.settings = settings
        self.channels = channels
        self.encoding = encoding
        width, hidden = encoding.width, settings.hidden
        inner = hidden or width
        if hidden:
            self.weight1 = nn.Parameter(torch.randn(count, width, hidden) / math.sqrt(width))
            self.bias1 = nn.Parameter(torch.randn(count, hidden) * 0.1)
        self.weight2 = nn.Parameter(
            torch.randn(count, inner, channels) * settings.init_scale / math.sqrt(inner)
        )
        self.bias2 = nn.Parameter(torch.full((count, channels), float(settings.init_bias)))

    def logits(self, position: Tensor) -> Tensor:
        """Return network outputs before the activation: position (B, 3) [m] -> (B, N, C)."""
        encoded = self.encoding(position)
        if not self.settings.hidden:
            return _shared_product(encoded, self.weight2) + self.bias2
        return self._networks(encoded.to(self.weight1.dtype))  # half precision of `torch.autocast`

    @full_precision
    def _networks(self, encoded: Tensor) -> Tensor:
        inner = _shared_product(encoded, self.weight1) + self.bias1
        leak = LEAK if self.settings.rectifier == "leaky_relu" else 0.0
        inner = nn.functional.leaky_relu(inner, leak)
        return torch.einsum("bnh,nhc->bnc", inner, self.weight2) + self.bias2

    def forward(self, position: Tensor, distance: Tensor) -> Tensor:
        """Return emissions (B, N, C) at positions (B, 3) [m]; distance (B, N)
        is d_i / d_ref (eq. 1).
        """
        logits = self.logits(position)
        if self.settings.log_distance:
            logits = logits.sub_(distance.log().unsqueeze(-1))
        if self.settings.activation in ("sigmoid", "signed_sigmoid"):
            bounded = logits.sigmoid_()
            return bounded if self.settings.activation == "sigmoid" else 2 * bounded - 1
        return nn.functional.softplus(logits) if self.settings.activation == "softplus" else logits

    def to_logits(self, emission: Tensor, distance: Tensor) -> Tensor:
        """Return the logits (n, N, C) whose emission this is:
        the inverse of `forward` after the network.
        """
        if self.settings.activation == "linear":
            return emission
        if self.settings.activation == "softplus":
            positive = emission.clamp_min(EMISSION_FLOOR)
            # log(e^x - 1), without its overflow.
            return positive + torch.log(-torch.expm1(-positive))
        logits = torch.logit(emission.clamp(EMISSION_FLOOR, 1 - EMISSION_FLOOR))
        return logits + distance.log().unsqueeze(-1) if self.settings.log_distance else logits


def _shared_product(encoded: Tensor, weight: Tensor) -> Tensor:
    """Features (B, E), the same of all Gaussians, times the weights (N, E, K) of each:
    (B, N, K).
    """
    count, width, outputs = weight.shape
    # One product, as all Gaussians read the same features.
    return (encoded @ weight.permute(1, 0, 2).reshape(width, count * outputs)).view(
        len(encoded), count, outputs
    )

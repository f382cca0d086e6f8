"""Confidence of a prediction: a network of position (paper, eq. 7; DUSt3R's form),
or what is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor, nn

from gsparc.base.limits import Checked, number, setting, whole
from gsparc.field.encoding import EncodingSettings, PositionEncoding


@dataclass(frozen=True)
class ConfidenceSettings(Checked):
    """The confidence network and its weight in the loss.

    Attributes:
        enabled: off means C = 1 and no network.
        hidden: hidden units (paper: 32).
        alpha: weight of -log C (paper: 0.3); the optimum without the floor is C = alpha / L.
        clamp: bound on |g|, so that exp(g) and C L stay finite in float32.
        encoding: how the moving end's position enters (paper: raw).
    """

    enabled: bool = True
    hidden: int = setting(32, whole(1))
    alpha: float = setting(0.3, number(0))
    clamp: float = setting(10.0, number(0, 80, open_low=True))
    encoding: EncodingSettings = field(default_factory=lambda: EncodingSettings(kind="raw"))


LEAST_UNKNOWN = 1e-3  # of the variance is always unknown: quantisation, recovery
ONE = torch.ones(())  # a number would cost each operation of a single query as much again


class ErrorModel(nn.Module):
    """The expected squared error of a pixel, `level (u + LEAST_UNKNOWN)^power`,
    of an unknown share u.

    What errors of left-out training rows say; nothing is learned by gradient.

    Attributes:
        far: the error far from all data, where u is 1.
        power: 0 where nothing is said about the share.
    """

    def __init__(self) -> None:
        super().__init__()
        # Numbers: as tensors they would cost a query a tenth of its time
        self.far, self.power = 1.0, 1.0

    def set_error_law(self, level: float, power: float) -> None:
        """Take what left-out rows said."""
        self.far, self.power = level * (1 + LEAST_UNKNOWN) ** power, power

    def forward(self, unknown: Tensor) -> tuple[Tensor, Tensor]:
        """Return variances (B,) of unknown shares (B,), and their shares (B,)
        of those far from all data.
        """
        certain = ONE.to(unknown.dtype)
        share = torch.lerp(unknown, certain, LEAST_UNKNOWN / (1 + LEAST_UNKNOWN)).pow(self.power)
        return share * self.far, share

    def get_extra_state(self) -> Tensor:
        """Return what `state_dict` holds beside tensors."""
        return torch.tensor([self.far, self.power], dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Read what `state_dict` held beside tensors."""
        self.far, self.power = (float(value) for value in state)


def fit_error_law(unknown: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Return (a, p): the expected squared error of a pixel is about
    `a (unknown + LEAST_UNKNOWN)^p`.

    The likeliest for errors (n,) that are exponential about it, so that their mean is right at
    every level: a line through logarithms would fit the many small errors
    and miss the few large ones.
    """
    x, y = np.log(unknown + LEAST_UNKNOWN), error + 1e-9

    def deviance(parameters: np.ndarray) -> float:
        level = parameters[0] + np.clip(parameters[1], 0.0, 2.0) * x
        return float((y * np.exp(-level) + level).mean())

    result = minimize(deviance, np.array([np.log(y.mean()), 0.5]), method="Nelder-Mead").x
    return float(np.exp(result[0])), float(np.clip(result[1], 0.0, 2.0))


class Confidence(nn.Module):
    """A network E -> hidden -> 1 of the moving end's position, and the stored range of its output.

    Args:
        settings: shape and weight.
        encoding: encoder of the position.
    """

    low: Tensor
    high: Tensor

    def __init__(self, settings: ConfidenceSettings, encoding: PositionEncoding) -> None:
        super().__init__()
        self.settings = settings
        self.encoding = encoding
        self.network = nn.Sequential(
            nn.Linear(encoding.width, settings.hidden), nn.ReLU(), nn.Linear(settings.hidden, 1)
        )
        # The range that normalises C is measured on calibration data, never on the test set.
        self.register_buffer("low", torch.zeros(()))
        self.register_buffer("high", torch.ones(()))

    def exponent(self, position: Tensor) -> Tensor:
        """Return g (B,), clamped, at positions (B, 3) [m]."""
        g = self.network(self.encoding(position)).squeeze(-1)
        g = g if g.dtype == torch.float64 else g.float()
        return g.clamp(-self.settings.clamp, self.settings.clamp)

    def store_range(self, position: Tensor) -> None:
        """Store the range of g over calibration positions (n, 3) [m]."""
        with torch.no_grad():
            g = self.exponent(position)
            self.low.copy_(g.min())
            self.high.copy_(torch.maximum(g.max(), g.min() + 1e-6))

    def normalised_confidence(self, position: Tensor) -> Tensor:
        """Return the confidence in [0, 1] (B,): C between its least and largest
        on the calibration data.

        It decays outside the box of what was measured, where the network's lines run on unchecked.
        """
        low, high, g = self.low.exp(), self.high.exp(), self.exponent(position).exp()
        offset = (position - self.encoding.centre) / self.encoding.half_extent
        outside = (offset.abs().amax(-1) - 1).clamp_min(0)
        return ((g - low) / (high - low)).clamp(0, 1) * torch.exp(-outside)


def weighted_loss(loss: Tensor, exponent: Tensor, alpha: float) -> Tensor:
    """Return C L - alpha log C per sample (paper, eq. 7): loss (B,), exponent g (B,) -> (B,).

    log C = log(1 + e^g) is a softplus, finite and with a finite slope for every g.
    """
    return (1 + exponent.exp()) * loss - alpha * nn.functional.softplus(exponent)

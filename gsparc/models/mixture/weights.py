"""Weights of several predictors: of least squared error, or of largest PSNR, on held-out rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.models.mixture.stacking import choose

LEAST_HELD = 4  # rows, for weights to mean anything
LEAST_GAIN_DB = 0.2  # for which a query may take several times as long
UNUSED = 0.05  # weight below which a predictor is left out
SHARES = np.linspace(0, 1, 21)  # candidates of a weight of two
LEAST_ERROR = 1e-9  # of a row: its logarithm stays finite


def weights(predicted: list[Tensor], target: Tensor, unit: np.ndarray) -> tuple[float, ...]:
    """Weights in [0, 1] of sum one: of one alone, unless a mixture is surely better; see `stacking.choose`.

    Args:
        predicted: M of (n, ...), real or complex, in the unit that errors are counted in.
        target: (n, ...).
        unit: (n,), rows of one unit are not independent.
    """
    missed = torch.stack([_real(one - target) for one in predicted], 1)  # (n, M, P)
    chosen = choose((missed @ missed.mT).numpy(), unit)
    return tuple(float(weight) for weight in chosen)


@dataclass(frozen=True)
class Rows:
    """Rows that two predictors did not learn from.

    Attributes:
        own, plain: (n, P) predictions of the first and the second.
        target: (n, P), the same entries as measured.
    """

    own: np.ndarray
    plain: np.ndarray
    target: np.ndarray

    def log_errors(self, weight: float) -> np.ndarray:
        """Logarithm (n,) of the mean squared error of each row, the second weighed by `weight`."""
        mixed = (1 - weight) * self.own + weight * self.plain
        return np.log(((mixed - self.target) ** 2).mean(1) + LEAST_ERROR)


def share_of_second(parts: Sequence[Rows]) -> float:
    """Weight in [0, 1] of the second of two predictors with which the mean PSNR over all rows is largest.

    0 or 1 where it is within `UNUSED` of them; 0 where less than `LEAST_GAIN_DB` is gained, but not where the
    second alone is better than the first: a query may take longer rather than lose to it.
    """
    means = [np.concatenate([part.log_errors(share) for part in parts]).mean() for share in SHARES]
    if means[0] <= means[-1] and 10 / np.log(10) * (means[0] - min(means)) < LEAST_GAIN_DB:
        return 0.0
    best = float(SHARES[int(np.argmin(means))])
    return round(best) if min(best, 1 - best) <= UNUSED + LEAST_ERROR else best


def error(predicted: Tensor, target: Tensor) -> float:
    """Share of the target's energy that is missed."""
    missed = (predicted - target).abs().square().sum()
    return float(missed / target.abs().square().sum().clamp_min(1e-30))


def explained(predicted: Tensor, target: Tensor, about_mean: bool) -> float:
    """Share of the variance that a prediction explains, of complex targets about zero; at most 1."""
    middle = target.mean(0, keepdim=True) if about_mean else torch.zeros_like(target[:1])
    whole = (target - middle).abs().square().sum().clamp_min(1e-30)
    return 1 - float((predicted - target).abs().square().sum() / whole)


def comparable(values: Tensor, site: Site) -> Tensor:
    """Values in the unit that errors are counted in: powers in decibels."""
    return 10 * values.clamp_min(1e-30).log10() if site.kind == "rssi" else values


def _real(values: Tensor) -> Tensor:
    values = torch.view_as_real(values.resolve_conj()) if values.is_complex() else values
    return values.detach().double().flatten(1)

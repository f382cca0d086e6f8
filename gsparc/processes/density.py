"""How likely rows are by a covariance, each left out (Rasmussen and Williams 2006, section 5.4.2),
or all.

With exact slopes: autograd brings them from the covariance to lengths, shares and noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.linalg import blas
from torch import Tensor

from gsparc.processes.censored import PseudoValues, log_evidence
from gsparc.processes.factor import BLAS, Factor

TINY = np.finfo(float).tiny
# Amplitude below which values are all alike, and tell of nothing: its inverse has a square
FLAT = 1e-150
EXCESS = 27.6  # nats at most: a factor of 1e12
LOG_NORMAL = math.log(2 * math.pi * math.e)
SETTLING, LEAST_STEEPNESS = 12, 1e-2  # steps to the common amplitude


class LeftOutSums(torch.autograd.Function):
    """Squared errors of rows left out one by one over their variances, summed,
    and logarithms of precisions.

    With R = K^-1 Y and q = diag(K^-1) the error of row i is R_i / q_i, its variance amplitude / q_i
    (Rasmussen and Williams 2006, eqs. 5.10 to 5.13, over outputs that share K).
    """

    @staticmethod
    def forward(ctx: Any, gram: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Sum over values (n, P) with a covariance `gram` (n, n) with noise,
        relative to the amplitude.
        """
        inverse = Factor.from_gram(gram.detach(), "raise").inverse
        ratio, share = inverse @ values, inverse.diagonal()
        ctx.save_for_backward(inverse, ratio)
        return (ratio.square().sum(1) / share).sum(), share.log().sum()

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Turn slopes by R = K^-1 Y and by diag(K^-1) into one by K: dK^-1 = -K^-1 dK K^-1."""
        inverse, ratio = ctx.saved_tensors
        (by_squares, by_logs), share = slopes, inverse.diagonal()
        by_ratio = by_squares * 2 * ratio / share[:, None]
        # Never negative, as a density falls with precisions:
        # with roots on both sides of a symmetric product.
        by_share = by_squares * ratio.square().sum(1) / share.square() - by_logs / share
        scaled = (inverse * by_share.sqrt()).numpy()
        with BLAS.limit(limits=1):
            # One triangle of a symmetric product: half the multiplications of all of it.
            lower = torch.from_numpy(blas.dsyrk(1.0, scaled.T, lower=0, trans=1)).T
        column = inverse @ by_ratio
        mixed = column @ ratio.T
        return lower + lower.tril(-1).T - 0.5 * (mixed + mixed.T), None


def left_out_density(
    parts: Sequence[tuple[Tensor, Tensor]],
    entries: int = 1,
    bounded: bool = True,
    alike: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Return the negative density of rows left out one by one [nats per output],
    and amplitudes (V,).

    These minimise it. Of several processes each is inverse gamma about a common one, which
    minimises it, too: one of few rows, or of equal values,
    has the common amplitude and divides nothing by its own spread.

    Args:
        parts: of V independent processes covariances (n, n) with noise, relative to the amplitude,
            and values (n, P) less the mean, coordinates in an orthonormal basis.
        entries: real numbers of a value, P or more.
        bounded: adds half the square of the amplitudes' excess in nats over the values' variance,
            for each process; without it few rows may choose a long one with next to no noise, good
            at neighbours.
        alike: rows that the common amplitude counts as, for one process.
    """
    sums = (LeftOutSums.apply(gram, values) for gram, values in parts)  # type: ignore[no-untyped-call]
    squares, logs = (torch.stack(part) / entries for part in zip(*sums, strict=True))
    count = squares.new_tensor([len(values) for _, values in parts])
    common = _common_amplitude(squares.detach(), count, alike) if alike else FLAT
    amplitude = ((squares + alike * common) / (count + alike)).clamp_min(FLAT)
    density = 0.5 * (
        (count + alike) * amplitude.log() - alike * math.log(common) + count * LOG_NORMAL
    )
    power = sum(float(values.square().sum()) for _, values in parts) / entries
    excess = (squares.sum().clamp_min(FLAT).log() - math.log(max(power, FLAT))).clamp(0.0, EXCESS)
    penalty = 0.5 * len(parts) * excess.square() if bounded else 0.0
    return (density - 0.5 * entries * logs).sum() + penalty, amplitude.detach()


def _common_amplitude(squares: Tensor, count: Tensor, alike: float) -> float:
    """The common one of largest density, of squares (V,) of n rows each:
    the harmonic mean of amplitudes.
    """
    common = (squares.sum() / count.sum()).clamp_min(FLAT)
    for _ in range(SETTLING):  # Newton's, of its logarithm
        weight = (count + alike) / (squares + alike * common)
        steepness = 1 - (weight * alike * common / (squares + alike * common)).sum() / weight.sum()
        step = (weight.mean() * common).log() / steepness.clamp_min(LEAST_STEEPNESS)
        common = (common * (-step).exp()).clamp_min(FLAT)
    return float(common)


class NegativeLogEvidence(torch.autograd.Function):
    """Negative logarithm of the probability of values, some of them only beyond a level."""

    @staticmethod
    def forward(
        ctx: Any, gram: Tensor, values: Tensor, side: Tensor, last: list[PseudoValues]
    ) -> Tensor:
        """Return minus what `log_evidence` does, ()."""
        value, slope, weights = log_evidence(gram.detach(), values.detach(), side, last)
        ctx.save_for_backward(slope, weights)
        return gram.new_tensor(-value)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Return slopes by the covariance, and by values and levels."""
        slope, weights = ctx.saved_tensors
        return -slopes[0] * slope, slopes[0] * weights, None, None


class ProfiledDensity(torch.autograd.Function):
    """Negative evidence of values of mean 0 at the amplitude that fits them best,
    and that amplitude.
    """

    @staticmethod
    def forward(ctx: Any, gram: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Score values (n, P) with a covariance (n, n)
        relative to the amplitude [nats per number].
        """
        factor = Factor.from_gram(gram.detach(), "raise")
        weights, (count, outputs) = factor.solve(values), values.shape
        amplitude = (values * weights).mean().clamp_min(TINY)
        ctx.save_for_backward(
            (outputs * factor.inverse - weights @ weights.T / amplitude) / (2 * count * outputs)
        )
        ctx.mark_non_differentiable(amplitude)
        return 0.5 * (amplitude.log() + factor.log_determinant / count), amplitude

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Return the slope by the covariance."""
        return slopes[0] * ctx.saved_tensors[0], None

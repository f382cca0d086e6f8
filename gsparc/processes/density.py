"""How likely rows are by a covariance, each left out (Rasmussen and Williams 2006, section 5.4.2), or all.

With exact slopes: autograd brings them from the covariance to lengths, shares and noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.linalg import blas
from torch import Tensor

from gsparc.processes.censored import PseudoValues, log_evidence
from gsparc.processes.factor import BLAS, Factor
from gsparc.processes.left_out import left_out_residuals

TINY = np.finfo(float).tiny


class LeftOutDensity(torch.autograd.Function):
    """Negative density of rows left out one by one, and the amplitude that minimises it.

    With R = K^-1 Y and q = diag(K^-1) the error of row i is R_i / q_i, its variance amplitude / q_i
    (Rasmussen and Williams 2006, eqs. 5.10 to 5.13, over outputs that share K).
    """

    @staticmethod
    def forward(ctx: Any, gram: Tensor, values: Tensor, entries: int, bounded: bool) -> tuple[Tensor, Tensor]:
        """Score values (n, P) with a covariance `gram` (n, n) with noise, relative to the amplitude.

        Args:
            ctx: of autograd.
            gram: see there.
            values: less the mean; coordinates in an orthonormal basis.
            entries: real numbers of a value, P or more.
            bounded: adds half the square of the amplitude's excess in nats over the values' variance; without
                it few rows may choose a long process with next to no noise, good at its neighbours alone.

        Returns:
            The density [nats per output], and the amplitude.
        """
        count, inverse = len(values), Factor.from_gram(gram.detach(), "raise").inverse
        ratio, share = inverse @ values, inverse.diagonal()
        squared = ratio.square().sum(1)
        # Where the slope by the amplitude is 0: the mean of squared errors over their relative variances.
        amplitude = max(float((squared / share).sum()) / (count * entries), TINY)
        density = 0.5 * count * math.log(2 * math.pi * math.e * amplitude) - 0.5 * float(share.log().sum())
        least = float(values.square().sum()) / (count * entries) if bounded else amplitude
        excess = max(math.log(amplitude / max(least, amplitude * 1e-12)), 0.0)
        steeper = (1 + 2 * excess / count) / (entries * amplitude)
        ctx.save_for_backward(inverse, ratio, steeper * ratio / share[:, None])
        ctx.by_share = -0.5 * (steeper * squared / share.square() + 1 / share)
        result = gram.new_tensor(amplitude)
        ctx.mark_non_differentiable(result)
        return gram.new_tensor(density + 0.5 * excess**2), result

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Turn slopes by R = K^-1 Y and by diag(K^-1) into one by K: dK^-1 = -K^-1 dK K^-1."""
        inverse, ratio, by_ratio = ctx.saved_tensors
        # These slopes are never positive: with their roots on both sides the product is symmetric.
        scaled = (inverse * (-ctx.by_share).sqrt()).numpy()
        with BLAS.limit(limits=1):
            # One triangle of a symmetric product: half the multiplications of all of it.
            lower = torch.from_numpy(blas.dsyrk(1.0, scaled.T, lower=0, trans=1)).T
        column = inverse @ by_ratio
        mixed = column @ ratio.T
        return slopes[0] * (lower + lower.tril(-1).T - 0.5 * (mixed + mixed.T)), None, None, None


class NegativeLogEvidence(torch.autograd.Function):
    """Negative logarithm of the probability of values, some of them only beyond a level."""

    @staticmethod
    def forward(ctx: Any, gram: Tensor, values: Tensor, side: Tensor, last: list[PseudoValues]) -> Tensor:
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
    """Negative evidence of values of mean 0 at the amplitude that fits them best, and that amplitude."""

    @staticmethod
    def forward(ctx: Any, gram: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Score values (n, P) with a covariance (n, n) relative to the amplitude [nats per number]."""
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


def density_without_groups(
    gram: Tensor, values: Tensor, partitions: Sequence[Iterable[Tensor]]
) -> tuple[Tensor, Tensor]:
    """Return the negative density of rows without their groups and without themselves, half and half.

    It is relative to the best amplitude [nats per row], which follows.

    Args:
        gram: (n, n) with noise, relative to the amplitude.
        values: (n, 1) less the mean.
        partitions: each of groups of rows that are left out together.
    """
    inverse = Factor.from_gram(gram, "raise").inverse
    parts = (groups for one in partitions for groups in (None, one))
    errors = [left_out_residuals(inverse, inverse @ values, groups) for groups in parts]
    variance = torch.cat([one.variance for one in errors])
    amplitude = (torch.cat([one.residual for one in errors])[:, 0].square() / variance).mean()
    return 0.5 * (amplitude.log() + variance.log().mean()), amplitude.detach()

"""Settings of a covariance by the density of rows left out, or by evidence, and the walk to the best.

Hyper-parameters of largest leave-one-out density (Rasmussen and Williams 2006, section 5.4.2), by its exact
slopes: autograd brings them from the covariance to lengths, shares and noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.linalg import blas
from scipy.optimize import minimize
from torch import Tensor

from gsparc.processes.censored import PseudoValues, log_evidence
from gsparc.processes.factor import BLAS, Factor, NotDefiniteError
from gsparc.processes.kernel import Kernel
from gsparc.processes.left_out import left_out_residuals

LOOKS = 40  # of a walk: most evaluations
# Gain of a step that is the last [nats of all rows]. Over rows a gain of g has a standard error of sqrt(2 g):
# below 2 none is sure. What remains after such a step is many times as much: at .5 it was 5 % of some errors.
SETTLED = 0.03
FINEST = 2e-5  # of them per number, of images, whose numbers are not independent: answers move by 1e-4 beyond
BAD = 1e12  # in place of a density where no Cholesky factor exists
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


def covariance_of(kernel: Kernel, distance: Tensor, columns: Tensor | None = None) -> Tensor:
    """Return the covariance (n, n) with noise, of amplitude 1, differentiable in the kernel's numbers.

    >>> covariance_of(Kernel.from_length(length=2.0, noise=0.5), torch.zeros(1, 1, dtype=torch.float64))
    tensor([[1.5000]], dtype=torch.float64)

    Args:
        kernel: of stationary terms.
        distance: (n, n) [m]; places (n, D) [m] where other than distances counts.
        columns: (n, P) of terms with unit normal weights; None: none.
    """
    total = kernel.correlation(distance) if kernel.is_isotropic else kernel.correlations(distance, distance)
    if columns is not None:
        total = total + columns @ columns.T
    return total + kernel.noise * torch.eye(len(distance), dtype=distance.dtype)


def minimise(
    objective: Callable[[Tensor], Tensor], starts: Sequence[np.ndarray],
    bounds: Sequence[tuple[float, float]], looks: int = LOOKS, settled: float = SETTLED,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Find where an objective is least, by L-BFGS-B from the best of some starts, and its value there.

    >>> best, value = minimise(lambda at: (at - 3).square().sum(), [np.zeros(1)], [(-5.0, 5.0)], 50, 1e-12)
    >>> best.round(3), round(value, 3)
    (array([3.]), 0.0)

    Args:
        objective: of parameters (p,) float64, with autograd.
        starts: (p,) each.
        bounds: p of them.
        looks: most evaluations.
        settled: gain of a step that is the last, in the objective's unit.
    """
    low, high = np.array(bounds).T

    @lru_cache(1 + len(starts))  # the walk begins by asking for the best start again
    def evaluate_bytes(values: bytes) -> tuple[float, np.ndarray]:
        point = np.frombuffer(values)
        at = torch.from_numpy(point.copy()).requires_grad_()
        try:
            value = objective(at)
        except NotDefiniteError:  # in float64: as bad as it gets
            return BAD, np.zeros(len(point))
        (slope,) = torch.autograd.grad(value, at)
        return float(value.detach()), slope.numpy()

    def evaluate(point: np.ndarray) -> tuple[float, np.ndarray]:
        return evaluate_bytes(point.tobytes())

    points = [np.clip(start, low, high) for start in starts]
    start = min(points, key=lambda point: evaluate(point)[0]) if len(points) > 1 else points[0]
    result = minimize(
        evaluate, start, jac=True, method="L-BFGS-B", bounds=list(zip(low, high, strict=True)),
        options={"ftol": settled / max(abs(evaluate(start)[0]), 1.0), "maxfun": looks},
    )  # fmt: skip
    return result.x, float(result.fun)


def fit_kernel(
    objective: Callable[[Kernel], tuple[Tensor, Tensor]], starts: Sequence[Kernel],
    bounds: Sequence[tuple[float, float]], looks: int = LOOKS, settled: float = SETTLED,
) -> tuple[float, Kernel]:  # fmt: skip
    """Find where an objective of kernels is least, and the kernel there, from the best of `starts` on.

    Args:
        objective: its value, with autograd, and the best amplitude.
        starts: of terms of one kind.
        bounds, looks, settled: see `minimise`.
    """
    first, points = starts[0], [one.parameters().numpy() for one in starts]
    best, _ = minimise(lambda at: objective(first.with_values(at))[0], points, bounds, looks, settled)
    with torch.no_grad():
        kernel = first.with_values(torch.from_numpy(best))
        value, amplitude = objective(kernel)
    return float(value), replace(kernel, amplitude=float(amplitude))


def fit_kernel_by_left_out(
    starts: Sequence[Kernel], distance: Tensor, columns: Tensor | None, values: Tensor,
    bounds: Sequence[tuple[float, float]] = (), looks: int = LOOKS,
    entries: int = 1, bounded: bool = True, partitions: Sequence[Iterable[Tensor]] = (),
) -> tuple[float, Kernel]:  # fmt: skip
    """Find the least negative density of rows left out [nats per output], and its kernel.

    They are left out one by one, and by `partitions` where there are any.
    """

    def objective(kernel: Kernel) -> tuple[Tensor, Tensor]:
        gram = covariance_of(kernel, distance, columns)
        if partitions:
            return density_without_groups(gram, values, partitions)
        value, amplitude = LeftOutDensity.apply(gram, values, entries, bounded)  # type: ignore[no-untyped-call]
        return value / len(values), amplitude

    bounds = bounds or starts[0].bounds(distance)
    settled = max(SETTLED / (len(values) * entries), FINEST)
    value, kernel = fit_kernel(objective, starts, bounds, looks, settled)
    return value * len(values), kernel

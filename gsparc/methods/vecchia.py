"""What the nearest rows tell of a place under a process of powers, and the settings most likely by that.

Settings maximise the density of rows given their nearest ones (A. V. Vecchia 1988, see `nearest_process`):
the leave-one-out likelihood of `gsparc.methods.power_kernel`, each row told by its neighbours alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.methods.power_kernel import BAD, PowerKernel, bounds_of, kernel_of
from gsparc.methods.worker import stop_when_late

JITTER = 1e-8  # of the amplitude, only so that a system of places millimetres apart can be solved
MOST_LOOKS = 40
EXCESS = 20.0  # nats, of an amplitude e times the variance of the values
TINY = 1e-30  # an amplitude has a logarithm


def correlation(
    distance: Tensor, lengths: Sequence[Tensor | float], shares: Sequence[Tensor | float]
) -> Tensor:
    """Sum of Matern-3/2 at distances [m], of any shape, with autograd."""
    total = torch.zeros_like(distance)
    for length, share in zip(lengths, shares, strict=True):
        far = distance * (math.sqrt(3) / length)
        total = total + share * (1 + far) * torch.exp(-far)
    return total


def weights_of(kernel: PowerKernel, places: Tensor, near: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (B, k) of near rows' values in the mean at places, and what they take off its variance (B,).

    Args:
        kernel: its lengths and shares are read; variances are of its amplitude.
        places: (B, D) float64 [m], with autograd.
        near: (B, k, D) [m].
        noise: (B, k) variances of the near values.
    """
    far = (places[:, None] - near).square().sum(-1).clamp_min(1e-24).sqrt()  # finite slope at 0
    apart = torch.cdist(near, near, compute_mode="donot_use_mm_for_euclid_dist")
    cross = correlation(far, kernel.lengths, kernel.shares)
    gram = correlation(apart, kernel.lengths, kernel.shares)
    gram.diagonal(dim1=-2, dim2=-1).add_(noise + JITTER)
    return solved(gram, cross)


def solved(gram: Tensor, cross: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (B, k), and what they take off the variance (B,), of covariances (B, k, k) and (B, k)."""
    lower = torch.linalg.cholesky(gram)
    weights = torch.cholesky_solve(cross[..., None], lower)[..., 0]
    return weights, (weights * cross).sum(-1)


@dataclass(frozen=True)
class Sample:
    """Rows with their nearest others.

    Attributes:
        far, apart: (T, k) and (T, k, k) distances from the near ones, and between these [m].
        value, near: (T,) and (T, k), less the mean law and its weighed terms [dB]; or (T, P) and (T, k, P),
            of P values that share their kernel and amplitude.
        count, counts: (T,) and (T, k) rows that each value is the mean of.
    """

    far: Tensor
    apart: Tensor
    value: Tensor
    near: Tensor
    count: Tensor
    counts: Tensor


def most_likely(starts: list[PowerKernel], sample: Sample, apart: np.ndarray) -> PowerKernel:
    """The kernel of largest density of rows given their neighbours, walked to from the best of `starts`.

    Args:
        starts: all of one number of lengths.
        sample: the rows.
        apart: distances between rows of the whole site [m], for bounds of lengths.
    """
    low, high = np.array(bounds_of(len(starts[0].lengths), apart)).T

    def objective(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.from_numpy(parameters).requires_grad_()
        try:
            value = _density(at, sample)[0]
        except torch.linalg.LinAlgError:  # in float64: as bad as it gets
            return BAD, np.zeros(len(parameters))
        (slope,) = torch.autograd.grad(value, at)
        return float(value.detach()), slope.numpy()

    points = [np.clip(one.parameters(), low, high) for one in starts]
    start = min(points, key=lambda point: objective(point)[0])
    pace = {"ftol": 5e-6, "maxfun": MOST_LOOKS}
    bounds = list(zip(low, high, strict=True))
    best = minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=pace, callback=stop_when_late
    ).x
    with torch.no_grad():
        amplitude = float(_density(torch.from_numpy(best), sample)[1])
    return kernel_of(best, amplitude)


def _density(parameters: Tensor, sample: Sample) -> tuple[Tensor, Tensor]:
    """Negative log density, mean over rows [nats], and the best amplitude, at `PowerKernel.parameters()`."""
    two = len(parameters) == 4
    share = torch.sigmoid(parameters[2]) if two else torch.ones((), dtype=parameters.dtype)
    lengths, noise = list(parameters[: 2 if two else 1].exp()), parameters[-1].exp()
    shares = [share, 1 - share] if two else [share]
    gram = correlation(sample.apart, lengths, shares) + torch.diag_embed(noise / sample.counts + JITTER)
    weights, known = solved(gram, correlation(sample.far, lengths, shares))
    variance = 1 + noise / sample.count - known
    if sample.value.ndim == 1:
        squared = (sample.value - (weights * sample.near).sum(1)).square()
    else:
        squared = (sample.value - torch.einsum("tk,tkp->tp", weights, sample.near)).square().mean(1)
    amplitude = (squared / variance).mean().clamp_min(TINY)
    # Near rows alone tell no long process of a huge amplitude from one of the values' own, see `left_out`.
    excess = (amplitude / sample.value.square().mean().clamp_min(TINY)).log().clamp_min(0.0)
    density = 0.5 * (amplitude.log() + variance.log().mean())
    return density + EXCESS * excess.square() / len(variance), amplitude

"""Covariance of powers in decibels: one or two Matern-3/2 of place beside the terms of a mean law.

Shadowing in a city has several lengths: of the gap between two houses, and of a quarter. Hyperparameters are
those of largest leave-one-out likelihood (Rasmussen and Williams 2006, section 5.4.2), by its exact gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, blas, cholesky, lapack
from scipy.optimize import minimize

LENGTH_SPAN = (1e-3, 3.0)  # bounds of a length, of the median distance between rows
NOISE_SPAN = (1e-6, 1e2)  # bounds of the noise's variance, of the amplitude
SHARES = 6.0  # bound of the logit of a share
MOST_LOOKS = 40
BAD = 1e12  # in place of a likelihood where no Cholesky factor exists


@dataclass(frozen=True)
class PowerKernel:
    """`amplitude (sum_k share_k Matern-3/2(distance / length_k) + noise identity + terms terms^T)`.

    Attributes:
        lengths: one or two [m].
        shares: of the same number, they sum to 1.
        noise: variance relative to `amplitude`.
        amplitude: [dB^2].
    """

    lengths: tuple[float, ...]
    shares: tuple[float, ...]
    noise: float
    amplitude: float

    def correlation(self, distance: np.ndarray) -> np.ndarray:
        """Sum of the Materns at distances [m], of any shape."""
        total = np.zeros_like(distance)
        for length, share in zip(self.lengths, self.shares, strict=True):
            far = distance * (np.sqrt(3) / length)
            total += share * (1 + far) * np.exp(-far)
        return total

    def gram(self, distance: np.ndarray, terms: np.ndarray) -> np.ndarray:
        """Covariance (n, n) with noise, relative to the amplitude.

        Args:
            distance: (n, n) [m].
            terms: (n, P) of the mean law.
        """
        matrix = self.correlation(distance) + terms @ terms.T
        matrix[np.diag_indices_from(matrix)] += self.noise
        return matrix

    def state(self) -> dict[str, list[float]]:
        """Numbers that `of` needs."""
        return {
            "lengths": [*self.lengths], "shares": [*self.shares], "kernel": [self.noise, self.amplitude]
        }  # fmt: skip

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> PowerKernel:
        """The kernel whose `state()` this was."""
        lengths, shares = (tuple(float(v) for v in state[name]) for name in ("lengths", "shares"))
        noise, amplitude = (float(v) for v in state["kernel"])
        return cls(lengths, shares, noise, amplitude)

    def parameters(self) -> np.ndarray:
        """Logarithms of lengths and noise, between them the logit of the first share where there are two."""
        logit = [np.log(self.shares[0] / self.shares[1])] if len(self.shares) == 2 else []
        return np.array([*np.log(self.lengths), *logit, np.log(self.noise)])


def kernel_of(parameters: np.ndarray, amplitude: float = 1.0) -> PowerKernel:
    """The kernel whose `parameters()` these are."""
    noise = float(np.exp(parameters[-1]))
    if len(parameters) == 2:
        return PowerKernel((float(np.exp(parameters[0])),), (1.0,), noise, amplitude)
    lengths, share = np.exp(parameters[:2]), float(1 / (1 + np.exp(-parameters[2])))
    return PowerKernel((float(lengths[0]), float(lengths[1])), (share, 1 - share), noise, amplitude)


def bounds_of(count: int, distance: np.ndarray) -> list[tuple[float, float]]:
    """Of the parameters of a kernel of `count` lengths, for rows at such distances (n, n) [m]."""
    scale = float(np.median(distance)) or float(distance.max()) or 1.0
    length = (np.log(scale * LENGTH_SPAN[0]), np.log(scale * LENGTH_SPAN[1]))
    share = [(-SHARES, SHARES)] if count == 2 else []
    return [*[length] * count, *share, (np.log(NOISE_SPAN[0]), np.log(NOISE_SPAN[1]))]


def slopes(kernel: PowerKernel, distance: np.ndarray, by_gram: np.ndarray) -> np.ndarray:
    """Derivatives by `kernel.parameters()`.

    Args:
        kernel, distance: as in `gram`.
        by_gram: (n, n), symmetric, derivatives by the entries of `gram`.
    """
    found, matern = [], []
    for length, share in zip(kernel.lengths, kernel.shares, strict=True):
        far = distance * (np.sqrt(3) / length)
        near = np.exp(-far)
        found.append(share * float(np.vdot(by_gram, far**2 * near)))
        matern.append((1 + far) * near)
    if len(matern) == 2:
        found.append(kernel.shares[0] * kernel.shares[1] * float(np.vdot(by_gram, matern[0] - matern[1])))
    return np.array([*found, kernel.noise * float(by_gram.trace())])


def inverse_of(gram: np.ndarray) -> tuple[np.ndarray, float]:
    """Inverse (n, n) of a positive-definite matrix, and the logarithm of its determinant.

    Raises:
        LinAlgError: it is not positive definite.
    """
    lower = cholesky(gram, lower=True, check_finite=False)
    inverse = lapack.dpotri(lower, lower=1)[0]
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    return inverse, 2 * float(np.log(lower.diagonal()).sum())


def left_out(
    kernel: PowerKernel,
    distance: np.ndarray,
    terms: np.ndarray,
    values: np.ndarray,
    bounded: bool = False,
) -> tuple[float, float, np.ndarray]:
    """Negative leave-one-out log density, the amplitude that minimises it, slopes by `kernel.parameters()`.

    With R = K^-1 y and q = diag(K^-1) the left-out error of row i is R_i / q_i and its variance
    amplitude / q_i (Rasmussen and Williams 2006, eqs. 5.10 to 5.13).

    Args:
        kernel, distance, terms: as in `PowerKernel.gram`.
        values: (n,) less the mean law [dB].
        bounded: adds half the square of the amplitude's excess in nats over the values' variance; without it
            few rows may choose a long process with next to no noise, good at its neighbours alone.

    Raises:
        LinAlgError: the covariance is not positive definite.
    """
    inverse, _ = inverse_of(kernel.gram(distance, terms))
    count, ratio, share = len(values), inverse @ values, inverse.diagonal()
    amplitude = max(float((ratio**2 / share).mean()), np.finfo(float).tiny)
    density = 0.5 * count * np.log(2 * np.pi * np.e * amplitude) - 0.5 * float(np.log(share).sum())
    least = float((values**2).mean()) if bounded else amplitude
    excess = max(math.log(amplitude / max(least, amplitude * 1e-12)), 0.0)
    density += 0.5 * excess**2
    steeper = 1 + 2 * excess / count
    by_ratio = steeper * ratio / (share * amplitude)
    by_share = -0.5 * (steeper * ratio**2 / (share**2 * amplitude) + 1 / share)
    # dK^-1 = -K^-1 dK K^-1: the slopes by R = K^-1 y and by diag(K^-1) become one by K.
    column = inverse @ by_ratio
    by_gram = blas.dsyrk(1.0, inverse * np.sqrt(-by_share), lower=1)
    by_gram = by_gram + np.tril(by_gram, -1).T - 0.5 * (np.outer(column, ratio) + np.outer(ratio, column))
    return density, amplitude, slopes(kernel, distance, by_gram)


def choose(
    starts: list[PowerKernel],
    distance: np.ndarray,
    terms: np.ndarray,
    values: np.ndarray,
    late: Callable[[], bool] = lambda: False,
) -> tuple[float, PowerKernel]:
    """Least negative leave-one-out log density, and its kernel, walked to from the best of `starts`.

    The walk ends where it is when `late` says so.
    """

    def stop(_: np.ndarray) -> None:
        if late():
            raise StopIteration

    bounds = bounds_of(len(starts[0].lengths), distance)
    low, high = np.array(bounds).T

    def objective(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            value, _, slope = left_out(kernel_of(parameters), distance, terms, values, bounded=True)
        except LinAlgError:  # in float64: as bad as it gets
            return BAD, np.zeros(len(parameters))
        return value / len(values), slope / len(values)

    points = [np.clip(one.parameters(), low, high) for one in starts]
    start = min(points, key=lambda point: objective(point)[0]) if len(points) > 1 else points[0]
    pace = {"ftol": 5e-6, "maxfun": MOST_LOOKS}
    best = minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=pace, callback=stop
    ).x
    value, amplitude, _ = left_out(kernel_of(best), distance, terms, values, bounded=True)
    return value, kernel_of(best, amplitude)

"""Correlations of places: one or more Matern parts, differentiable in places, lengths and shares."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gsparc.ops.transforms import beyond_kernels

LENGTH_SPAN = (1e-3, 3.0)  # bounds of a length, of the median distance between rows
NOISE_SPAN = (1e-6, 1e2)  # bounds of the noise's variance, of the amplitude
SHARES = 6.0  # bound of the logit of a share
ROUGH_SHARE = 0.15  # of the variance; minimises the held-out error on training spectra, flat from 0.1 to 0.3
ROUGH_RATIO = 1 / 3  # of the lengths
ONE = torch.ones(())  # a number would cost each operation of a single query as much again


def apart(a: Tensor, b: Tensor) -> Tensor:
    """Return distances (..., n, m) [m] of places (..., n, D) and (..., m, D), with gradients; exact at 0.

    Differences are formed before squaring: the expanded form loses millimetres in float32.

    >>> apart(torch.zeros(1, 3), torch.tensor([[3.0, 4.0, 0.0]]))
    tensor([[5.]])
    """
    if not beyond_kernels(a, b):
        return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
    squared = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)  # `cdist` has no forward mode
    none = squared == 0
    # The inner `where` keeps the root's slope at 0, which is infinite, out of the gradient.
    return torch.where(none, 0.0, torch.where(none, 1.0, squared).sqrt())


def matern32(distance: Tensor, length: Tensor | float) -> Tensor:
    """Return the Matern-3/2 correlation of distances (...) [m].

    >>> matern32(torch.tensor([0.0, 2.0]), length=2.0)
    tensor([1.0000, 0.4834])
    """
    # Rasmussen and Williams 2006, eq. 4.17: (1 + s) exp(-s) with s = sqrt(3) d / length.
    scaled = distance * (-math.sqrt(3) / length)
    return torch.sub(ONE, scaled) * scaled.exp()


def matern32_of_squares(squared: Tensor) -> Tensor:
    """Return the Matern-3/2 of squared distances (...) in units of the length, with a slope at 0."""
    # What is added keeps the slope of the root finite where two places are one.
    root = (3 * squared + 1e-9).sqrt()
    return (1 + root) * torch.exp(-root)


def matern52(distance: Tensor, length: Tensor | float) -> Tensor:
    """Return the Matern-5/2 correlation of distances (...) [m].

    >>> matern52(torch.tensor([0.0, 2.0]), length=2.0)
    tensor([1.0000, 0.5240])
    """
    # The same equation: (1 + s + s^2 / 3) exp(-s) with s = sqrt(5) d / length.
    scaled = distance * (-math.sqrt(5) / length)
    return torch.addcmul(torch.sub(ONE, scaled), scaled, scaled, value=1 / 3) * scaled.exp()


def matern_sum(
    distance: Tensor, lengths: Sequence[Tensor | float], shares: Sequence[Tensor | float]
) -> Tensor:
    """Return the sum of Matern-3/2 correlations of several lengths [m] at distances (...) [m].

    >>> matern_sum(torch.tensor([0.0, 2.0]), lengths=(2.0, 20.0), shares=(0.5, 0.5))
    tensor([1.0000, 0.7350])
    """
    if len(lengths) == 1:
        return matern32(distance, lengths[0])
    parts = zip(lengths, shares, strict=True)
    return sum((share * matern32(distance, length) for length, share in parts), torch.zeros_like(distance))


def smooth_rough(distance: Tensor, length: float) -> Tensor:
    """Return a smooth long part, Matern-5/2, and a rough short one, Matern-3/2 of a third of `length`."""
    return torch.lerp(matern52(distance, length), matern32(distance, ROUGH_RATIO * length), ROUGH_SHARE)


@dataclass(frozen=True)
class Kernel:
    """`amplitude (sum_k share_k Matern-3/2(distance / length_k) + noise identity)`.

    >>> kernel = Kernel(lengths=(5.0, 50.0), shares=(0.4, 0.6), noise=0.1)
    >>> kernel.gram(torch.zeros(1, 2, dtype=torch.float64))  # one place: its variance and that of the noise
    tensor([[1.1000]], dtype=torch.float64)
    >>> Kernel.of(kernel.parameters()).parameters().round(3).tolist() == kernel.parameters().round(3).tolist()
    True

    Attributes:
        lengths: one or two [m].
        shares: of the same number, they sum to 1.
        noise: variance relative to `amplitude`.
        amplitude: variance of a value.
    """

    lengths: tuple[float, ...]
    shares: tuple[float, ...]
    noise: float
    amplitude: float = 1.0

    @classmethod
    def of_one(cls, length: float, noise: float, amplitude: float = 1.0) -> Self:
        """Return a kernel with one length [m]."""
        return cls((length,), (1.0,), noise, amplitude)

    def correlation(self, distance: Tensor) -> Tensor:
        """Return correlations at distances (...) [m]."""
        return matern_sum(distance, self.lengths, self.shares)

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return correlations (..., n, m) of places (..., n, D) and (..., m, D) [m]."""
        return self.correlation(apart(a, b))

    def gram(self, places: Tensor) -> Tensor:
        """Return correlations (n, n) with noise of places (n, D) [m]."""
        result = self.between(places, places)
        result.diagonal().add_(self.noise)
        return result

    @property
    def length(self) -> float:
        """The first [m]."""
        return self.lengths[0]

    def state(self) -> dict[str, list[float]]:
        """Return numbers that `read` needs."""
        return {
            "lengths": [*self.lengths], "shares": [*self.shares], "kernel": [self.noise, self.amplitude]
        }  # fmt: skip

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> Self:
        """Return the kernel whose `state()` this was."""
        lengths, shares = (tuple(float(v) for v in state[name]) for name in ("lengths", "shares"))
        return cls(lengths, shares, *(float(v) for v in state["kernel"]))

    def parameters(self) -> np.ndarray:
        """Return logarithms of lengths and noise, between them the logit of the first share of two."""
        logit = [math.log(self.shares[0] / self.shares[1])] if len(self.shares) == 2 else []
        return np.array([*np.log(self.lengths), *logit, math.log(self.noise)])

    @classmethod
    def of(cls, parameters: np.ndarray, amplitude: float = 1.0) -> Self:
        """Return the kernel whose `parameters()` these are."""
        lengths, shares, noise = unpacked(torch.from_numpy(np.asarray(parameters, np.float64)))
        return cls(tuple(map(float, lengths)), tuple(map(float, shares)), float(noise), amplitude)


@dataclass(frozen=True)
class WaveKernel:
    """`amplitude (sin(kd) / (kd) Matern-3/2(d / length) + noise identity)`: waves from everywhere alike.

    Where both ends move it is the product over both, as waves leave in all directions as they arrive from all
    (R. K. Cook et al., J. Acoust. Soc. Am. 27 (1955)).

    >>> kernel = WaveKernel(wavenumber=2 * math.pi, length=1e6)  # of 1 m wavelength
    >>> kernel.between(torch.zeros(1, 3), torch.tensor([[0, 0, 0.75], [0.25, 0, 0]])).round(decimals=3)
    tensor([[-0.2120,  0.6370]])

    Attributes:
        wavenumber: [rad/m].
        length: of the envelope [m].
        noise: variance relative to `amplitude`.
        amplitude: variance of a complex value.
    """

    wavenumber: float
    length: Tensor | float
    noise: float = 0.0
    amplitude: float = 1.0

    def between(self, a: Tensor, b: Tensor) -> Tensor:
        """Return correlations (..., n, m) of places (..., n, 3), (..., m, 3) of one end, or 6 of both [m]."""
        ends = [apart(*pair) for pair in zip(a.split(3, -1), b.split(3, -1), strict=True)]
        # `torch.sinc` has pi in its argument: sin(pi x) / (pi x).
        waves = [
            torch.sinc(each * (self.wavenumber / math.pi)) * matern32(each, self.length) for each in ends
        ]
        return waves[0] if len(waves) == 1 else waves[0] * waves[1]

    def state(self) -> dict[str, list[float]]:
        """Return numbers that `read` needs."""
        return {"wave": [self.wavenumber, float(self.length), self.noise, self.amplitude]}

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> Self:
        """Return the kernel whose `state()` this was."""
        return cls(*(float(v) for v in state["wave"]))


class SmoothRough(Kernel):
    """The same with one `smooth_rough` part, of array vectors and emissions."""

    def correlation(self, distance: Tensor) -> Tensor:
        """Return correlations at distances (...) [m]."""
        return smooth_rough(distance, self.lengths[0])


def unpacked(parameters: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Return lengths, shares and noise of `Kernel.parameters()` (2,) or (4,), differentiable."""
    if len(parameters) == 2:
        return [parameters[0].exp()], [torch.ones_like(parameters[0])], parameters[1].exp()
    # Of a logit both shares lie between 0 and 1, whatever a step does.
    share = torch.sigmoid(parameters[2])
    return list(parameters[:2].exp()), [share, 1 - share], parameters[3].exp()


def bounds_of(count: int, distance: np.ndarray) -> list[tuple[float, float]]:
    """Return bounds of the parameters of a kernel of `count` lengths, for rows at distances (...) [m].

    >>> [round(low, 2) for low, high in bounds_of(1, np.array([10.0]))]  # logarithms of length and noise
    [-4.61, -13.82]
    """
    # All rows may stand at one place, whose distances are 0.
    scale = float(np.median(distance)) or float(distance.max()) or 1.0
    length = (math.log(scale * LENGTH_SPAN[0]), math.log(scale * LENGTH_SPAN[1]))
    share = [(-SHARES, SHARES)] if count == 2 else []
    return [*[length] * count, *share, (math.log(NOISE_SPAN[0]), math.log(NOISE_SPAN[1]))]

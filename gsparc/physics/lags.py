"""A Bartlett spectrum as its lags: one complex number per difference of array elements.

`P(u) = a(u)^H R a(u) = sum_d r_d exp(-j k u.d)` over the differences d of the elements; a plane
wave of unit power from v has `r_d = c_d / M^2 exp(+j k v.d)`,
c_d being how many pairs of elements are d apart.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsparc.ops import SphereGrid
from gsparc.physics.array_response import make_co_array
from gsparc.physics.separable import Separable, fit_separable

BLOCK = 128  # images at once
RIDGE = 1e-7  # of the mean energy: directions beyond the horizon leave some lags undetermined
LOST = 1e-12  # of the energy of a lag's image in its separable form: a float32's rounding


class SpectrumLags:
    """The lags of an array on a grid.

    Args:
        array: (M, 3) [m] elements, receiver frame.
        grid: directions of the pixels.
        wavelength: [m].

    Attributes:
        count: real numbers per spectrum.
        pixels: basis of all spectra.
        gram: (count, count) float64, inner products of the lags' images.
    """

    def __init__(self, array: np.ndarray, grid: SphereGrid, wavelength: float) -> None:
        lags = make_co_array(array, wavelength)
        # Radians per unit of direction
        differences = 2 * np.pi * np.round(lags.difference / wavelength, 6)
        self._differences = torch.from_numpy(differences.T).float()
        # Of the pairs that are d apart, half are so the other way round.
        pairs = lags.real_pairs.sum(0)[: len(differences)]
        pairs[1:] /= 2
        self._share, self.count = (pairs / lags.elements**2).float(), lags.real_pairs.shape[1]
        angle = differences @ grid.directions().numpy().reshape(-1, 3).T
        waves = torch.from_numpy(np.concatenate([np.cos(angle), np.sin(angle[1:])]))
        # Of d and -d together: r e^(-j a) + conj(r) e^(j a) = 2 (Re r cos a + Im r sin a).
        waves[1:] *= 2
        basis = waves.reshape(self.count, grid.height, grid.width)
        self.pixels = fit_separable(basis.split(BLOCK), LOST)  # in float64
        self._basis = self.pixels.project(basis.float())
        exact = self._basis.double()  # in float32, rounding would be most of the weakest lags
        self.gram = exact @ exact.T
        self.gram.diagonal().add_(RIDGE * self.gram.diagonal().mean())
        self._inverse = torch.linalg.solve(self.gram, exact).T

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width [pixels]."""
        return self.pixels.image_shape

    def plane_wave_lags(self, directions: Tensor) -> Tensor:
        """Return lags (..., count) float32 of plane waves of unit power
        from unit vectors (..., 3).
        """
        angle = directions @ self._differences
        return torch.cat(
            [self._share * angle.cos(), self._share[1:] * angle[..., 1:].sin()], dim=-1
        )

    def to_lags(self, power: Tensor) -> Tensor:
        """Return lags (n, count) of spectra (n, H, W) in power, by least squares."""
        return (self.pixels.project(power).double() @ self._inverse).float()

    def spectrum(self, lags: Tensor, pixels: Separable | None = None) -> Tensor:
        """Return power (n, H, W), at least 0, of lags (n, count); on `pixels`, thinned ones,
        if given.
        """
        return (pixels or self.pixels).images(lags @ self._basis).clamp_min(0)


def pixel_exponent(space: SpectrumLags, images: Tensor) -> tuple[int, float]:
    """Return 2 if images (n, H, W) are amplitudes, 1 if powers,
    and the energy share outside the lags.
    """
    residual = {}
    for exponent in (2, 1):
        power = images**exponent
        again = space.spectrum(space.to_lags(power))
        residual[exponent] = float((again - power).square().sum() / power.square().sum())
    exponent = min(residual, key=lambda e: residual[e])
    return exponent, residual[exponent]

"""A Bartlett spectrum as its lags: one complex number per difference of array elements.

`P(u) = a(u)^H R a(u) = sum_d r_d exp(-j k u.d)` over the differences d of the elements; a plane wave of unit
power from v has `r_d = c_d / M^2 exp(+j k v.d)`, c_d being how many pairs of elements are d apart.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsparc.ops import SphereGrid

BLOCK = 128  # images at once
RIDGE = 1e-7  # of the mean energy: directions beyond the horizon leave some lags undetermined


class Lags:
    """The lags of an array on a grid.

    Args:
        array: (M, 3) [m] elements, receiver frame.
        grid: directions of the pixels.
        wavelength: [m].

    Attributes:
        count: real numbers per spectrum.
    """

    def __init__(self, array: np.ndarray, grid: SphereGrid, wavelength: float) -> None:
        between = (array[:, None] - array[None]).reshape(-1, 3) / wavelength
        unique, pairs = np.unique(np.round(between, 6), axis=0, return_counts=True)
        # d and -d are conjugates: the half whose first coordinate other than zero is positive is enough
        sign = np.array([next((np.sign(v) for v in row if v != 0), 0.0) for row in unique])
        half = sign >= 0
        self._differences = 2 * np.pi * unique[half]  # radians per unit of direction
        self._share = pairs[half] / len(array) ** 2
        self._sine = sign[half] > 0  # the zero lag has none
        self.count = len(self._share) + int(self._sine.sum())
        self.image = (grid.height, grid.width)
        directions = grid.directions().numpy().reshape(-1, 3)
        twice = np.where(self._sine, 2.0, 1.0)
        weight = np.concatenate([twice, twice[self._sine]])
        angle = directions @ self._differences.T
        waves = np.concatenate([np.cos(angle), np.sin(angle)[:, self._sine]], axis=1)
        self._basis = torch.from_numpy((waves * weight).astype(np.float32)).T
        gram = (self._basis @ self._basis.T).double().numpy()
        gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / len(gram)
        self._inverse = torch.from_numpy(np.linalg.inv(gram)).float()

    def atoms(self, directions: Tensor) -> Tensor:
        """Lags (..., count) float32 of plane waves of unit power from unit vectors (..., 3)."""
        angle = directions @ torch.from_numpy(self._differences.astype(np.float32)).T
        share = torch.from_numpy(self._share.astype(np.float32))
        sine = torch.from_numpy(self._sine)
        return torch.cat([share * angle.cos(), (share * angle.sin())[..., sine]], dim=-1)

    def of(self, power: Tensor) -> Tensor:
        """Lags (n, count) of spectra (n, H, W) in power, by least squares."""
        return (power.reshape(len(power), -1) @ self._basis.T) @ self._inverse

    def spectrum(self, lags: Tensor) -> Tensor:
        """Power (n, H, W), at least 0, of lags (n, count)."""
        return (lags @ self._basis).clamp_(min=0).reshape(-1, *self.image)

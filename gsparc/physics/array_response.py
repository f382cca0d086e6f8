"""Response of a static antenna array to arriving waves: `h = A z`,
the Bartlett spectrum `|A^H h|`, its lags.

The squared spectrum of M elements is a trigonometric polynomial: `|A^H h|^2 = B r`, where the
columns of B are the cosines and sines of the array's distinct element differences (its co-array; 49
columns for a 4 x 4 grid) and r the sums of `h_m conj(h_n)` over the pairs with that difference. Van
Trees 2002, "Optimum array processing", ch. 2 and 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.ops import SphereGrid

SAME_LAG = 1e-4  # two element differences closer than this many wavelengths are one lag


def steering_matrix(array: np.ndarray, grid: SphereGrid, wavelength: float) -> Tensor:
    """Return the steering matrix A (M, H * W) complex128: `exp(+j k u.a_m)`.

    >>> array = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])  # half a wavelength of 10 cm apart
    >>> steering_matrix(array, SphereGrid.hemisphere(1, 4), 0.1)[1].real.round(decimals=3)
    tensor([-1.,  1., -1.,  1.], dtype=torch.float64)

    Args:
        array: (M, 3) [m], receiver frame.
        grid: directions u.
        wavelength: [m].
    """
    turns = (
        torch.from_numpy(np.asarray(array, dtype=np.float64)) @ grid.directions().reshape(-1, 3).T
    )
    return torch.exp(2j * math.pi / wavelength * turns)


def element_pattern(grid: SphereGrid, exponent: float) -> Tensor:
    """Return an element's amplitude (H, W) float64: cos^exponent of the angle off boresight,
    0 behind.
    """
    return grid.directions()[..., 2].clamp_min(0) ** exponent


def array_output(
    waves: Tensor, matrix: Tensor, grid: SphereGrid, pattern: Tensor | None = None
) -> Tensor:
    """Return `h = A z` (B, M): what the elements measure of complex amplitudes z (B, H, W)
    per steradian.

    Args:
        waves: arriving field per direction, complex.
        matrix: A of `steering_matrix`, same precision as `waves`.
        grid: its solid angles are the weights of the sum.
        pattern: (H, W) element amplitude; None for isotropic elements.
    """
    weight = grid.solid_angles().to(waves.device)
    weight = weight if pattern is None else weight * pattern
    return (waves * weight.to(waves.real.dtype)).flatten(1) @ matrix.T


def bartlett_spectrum(vectors: Tensor, matrix: Tensor) -> Tensor:
    """Return `|A^H h|` (B, H * W) of array vectors (B, M); its slope where it vanishes is 0.

    >>> array, grid = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]), SphereGrid.hemisphere(1, 4)
    >>> matrix = steering_matrix(array, grid, 0.1)

    A wave along y interferes at x:

    >>> bartlett_spectrum(matrix[:, 1][None], matrix).round(decimals=3)
    tensor([[0., 2., 0., 2.]], dtype=torch.float64)
    """
    return (vectors @ matrix.conj()).abs()  # torch takes the slope at 0 as 0


def normalise_spectrum(image: Tensor, how: str) -> Tensor:
    """Scale spectra (B, P) as a dataset publishes them: `max`, `minmax`, `power` (mean square 1)
    or `none`.

    >>> normalise_spectrum(torch.tensor([[1.0, 2.0, 5.0]]), "minmax")
    tensor([[0.0000, 0.2500, 1.0000]])

    Raises:
        ValueError: another name.
    """
    if how == "none":
        return image
    low = image.amin(1, keepdim=True) if how == "minmax" else image.new_zeros(len(image), 1)
    if how in ("max", "minmax"):
        high = image.amax(1, keepdim=True)
    elif how == "power":
        high = image.square().mean(1, keepdim=True).sqrt()
    else:
        raise ValueError(f"normalisation {how!r} is none of max, minmax, power, none")
    # The least divisor leaves a silent spectrum at 0; it would be NaN.
    return (image - low) / (high - low).clamp_min(1e-12)


@dataclass(frozen=True)
class CoArray:
    """The distinct element differences of an array, one of each pair +-d, the zero lag first.

    Attributes:
        difference: (L, 3) [m], `difference[0]` is 0.
        real_pairs, imag_pairs: (M * M, 2 L - 1) float64, which lag numbers the real and imaginary
            parts of the products `h_m conj(h_n)` add to.
        elements: M.
    """

    difference: np.ndarray
    real_pairs: Tensor
    imag_pairs: Tensor
    elements: int

    def spectrum_basis(self, grid: SphereGrid, wavelength: float) -> Tensor:
        """Return B (H * W, 2 L - 1) float64: `|A^H h|^2 = B r`, r the zero lag,
        real and imaginary parts.
        """
        phase = grid.directions().reshape(-1, 3) @ torch.from_numpy(self.difference[1:].T)
        phase = 2 * math.pi / wavelength * phase
        return torch.cat(
            [torch.ones(len(phase), 1, dtype=torch.float64), phase.cos(), phase.sin()], 1
        )

    def quadratic_forms(self) -> Tensor:
        """Return symmetric S (2 L - 1, 2 M, 2 M) float64 with `r_i = v^T S_i v`,
        v = (Re h, Im h).
        """
        m = self.elements
        real = self.real_pairs.T.reshape(-1, m, m)
        imag = self.imag_pairs.T.reshape(-1, m, m)
        # Re(h_m conj(h_n)) = a_m a_n + b_m b_n, Im = b_m a_n - a_m b_n.
        whole = torch.cat([torch.cat([real, -imag], 2), torch.cat([imag, real], 2)], 1)
        return (whole + whole.transpose(1, 2)) / 2


def make_co_array(array: np.ndarray, wavelength: float) -> CoArray:
    """Return the co-array of element positions (M, 3) [m];
    differences within 1e-4 wavelengths are one.

    >>> axes = *np.meshgrid(np.arange(4), np.arange(4)), np.zeros((4, 4))
    >>> square = np.stack(axes, -1).reshape(-1, 3)
    >>> make_co_array(0.16 * square, 0.32).difference.shape  # 24 pairs +-d, and zero
    (25, 3)
    """
    array = np.asarray(array, dtype=np.float64)
    m = len(array)
    difference = array[:, None] - array[None]
    # As whole numbers: rounding would make two lags of one difference.
    cell = np.round(difference / (SAME_LAG * wavelength)).astype(np.int64).reshape(-1, 3)
    # One half-space of differences: the first nonzero coordinate is positive.
    lead = np.where(cell[:, 0] != 0, cell[:, 0], np.where(cell[:, 1] != 0, cell[:, 1], cell[:, 2]))
    sign = np.sign(lead)
    unique, which = np.unique(
        cell * np.where(sign == 0, 1, sign)[:, None], axis=0, return_inverse=True
    )
    which = which.reshape(-1)
    zero = int(np.flatnonzero((unique == 0).all(1))[0])
    # The zero lag is the first, as it alone has no sine.
    order = np.concatenate([[zero], np.delete(np.arange(len(unique)), zero)])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    which = rank[which]
    size = 2 * len(unique) - 1
    real, imag = np.zeros((m * m, size)), np.zeros((m * m, size))
    pairs = np.arange(m * m)
    real[pairs, which] = 1.0
    moved = which > 0
    # h_m conj(h_n) e^{-j k d.u}: Re cos + Im sin, and its conjugate twin sits at -d.
    imag[pairs[moved], len(unique) - 1 + which[moved]] = sign[moved]
    differences = np.stack(
        [difference.reshape(-1, 3)[(which == i) & (sign >= 0)].mean(0) for i in range(len(unique))]
    )
    return CoArray(differences, torch.from_numpy(real), torch.from_numpy(imag), m)

"""The frozen small matrix of a static array: vectors and a noise floor in, whole spectra out."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.array.response import lags, steering
from gsparc.data.schema import Site

TINY = 1e-9  # of a squared spectrum: keeps the slope of the square root finite


class SpectrumRenderer(nn.Module):
    """`sqrt(|A^H h|^2 + f^2 b^2)`: spectra of array vectors h over an incoherent background b of share f.

    The square is a product with a fixed matrix of lag numbers (response.py). For a planar array on a grid
    that closes the circle the cosines are equal and the sines opposite half a turn apart, so that half the
    rows serve all pixels: 50 x 16,200 instead of 32 x 64,800 multiplications for 4 x 4 elements, exactly.

    Args:
        site: array, wavelength and grid.
        background: (H, W) amplitude.
    """

    real_pairs: Tensor
    imag_pairs: Tensor
    even: Tensor
    odd: Tensor

    def __init__(self, site: Site, background: Tensor) -> None:
        super().__init__()
        assert site.array is not None and site.grid is not None and site.wavelength is not None
        grid, known = site.grid, lags(site.array, site.wavelength)
        self.height, self.width = grid.height, grid.width
        planar = float(np.ptp(site.array[:, 2])) < 1e-6 * site.wavelength
        self.half_turn = planar and grid.periodic and grid.width % 2 == 0
        self.register_buffer("real_pairs", known.real_pairs.float())
        self.register_buffer("imag_pairs", known.imag_pairs.float())
        basis = known.basis(grid, site.wavelength)
        square = background.double().square().reshape(-1, 1)
        count = len(known.difference)
        if self.half_turn:
            shape = (grid.height, 2, grid.width // 2)
            near = basis.reshape(*shape, -1)[:, 0].flatten(0, 1)
            here, there = square.reshape(shape).unbind(1)
            even = torch.cat([near[:, :count], (here + there).reshape(-1, 1) / 2], 1)
            odd = torch.cat([near[:, count:], (here - there).reshape(-1, 1) / 2], 1)
        else:
            even, odd = torch.cat([basis[:, :count], square], 1), basis[:, count:]
        self.register_buffer("even", even.T.float().contiguous())
        self.register_buffer("odd", odd.T.float().contiguous())
        self.split = count

    def forward(self, vectors: Tensor, floor: Tensor) -> Tensor:
        """Spectra (B, H, W) of vectors (B, M) complex64 and floors f (B, 1) float32; differentiable."""
        products = (vectors[:, :, None] * vectors[:, None, :].conj()).flatten(1)
        r = torch.addmm(products.real @ self.real_pairs, products.imag, self.imag_pairs)
        share = floor.square()
        even = torch.cat([r[:, : self.split], share], 1) @ self.even
        if self.half_turn:
            odd = torch.cat([r[:, self.split :], share], 1) @ self.odd
            even, odd = (part.view(-1, self.height, self.width // 2) for part in (even, odd))
            square = torch.cat([even + odd, even - odd], 2)
        else:
            square = (even + r[:, self.split :] @ self.odd).view(-1, self.height, self.width)
        return square.clamp_min(TINY).sqrt()


def spectra(site: Site, vectors: Tensor) -> Tensor:
    """`|A^H h|` (B, H, W) without shortcuts: what `SpectrumRenderer` must equal where nothing is unknown."""
    assert site.array is not None and site.grid is not None and site.wavelength is not None
    matrix = steering(site.array, site.grid, site.wavelength).to(vectors.dtype)
    return (vectors @ matrix.conj()).abs().view(-1, site.grid.height, site.grid.width)

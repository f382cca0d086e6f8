"""The frozen small matrix of a static array: vectors and a noise floor in, whole spectra out."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.array.response import Lags, lags, steering
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

    pairs: Tensor
    even: Tensor
    odd: Tensor

    def __init__(self, site: Site, background: Tensor) -> None:
        super().__init__()
        assert site.array is not None and site.grid is not None and site.wavelength is not None
        grid, known = site.grid, lags(site.array, site.wavelength)
        self.height, self.width = grid.height, grid.width
        planar = float(np.ptp(site.array[:, 2])) < 1e-6 * site.wavelength
        self.half_turn = planar and grid.periodic and grid.width % 2 == 0
        basis = known.basis(grid, site.wavelength)
        square = background.double().square().reshape(-1, 1)
        self.count = len(known.difference)
        if self.half_turn:
            shape = (grid.height, 2, grid.width // 2)
            near = basis.reshape(*shape, -1)[:, 0].flatten(0, 1)
            here, there = square.reshape(shape).unbind(1)
            even = torch.cat([near[:, : self.count], (here + there).reshape(-1, 1) / 2], 1)
            odd = torch.cat([near[:, self.count :], (here - there).reshape(-1, 1) / 2], 1)
        else:
            even = torch.cat([basis[:, : self.count], square], 1)
            odd = torch.cat([basis[:, self.count :], torch.zeros_like(square)], 1)
        self.register_buffer("even", even.T.float().contiguous())
        self.register_buffer("odd", odd.T.float().contiguous())
        self.register_buffer("pairs", _extended_pairs(known))

    def forward(self, vectors: Tensor) -> Tensor:
        """Spectra (B, H, W) of (B, M + 1) complex64: array vectors and last the share f; differentiable."""
        even, odd = self._halves(vectors)
        square = torch.cat([even + odd, even - odd], 2) if self.half_turn else even + odd
        return square.clamp_min(TINY).sqrt()

    @torch.no_grad()
    def draw(self, vectors: Tensor) -> Tensor:
        """The same, cut off at 1, in as few passes over the pixels as there can be."""
        even, odd = self._halves(vectors)
        if self.half_turn:
            square = even.new_empty(len(even), self.height, self.width)
            torch.add(even, odd, out=square[:, :, : self.width // 2])
            torch.sub(even, odd, out=square[:, :, self.width // 2 :])
        else:
            square = even.add_(odd)
        return square.clamp_(TINY, 1).sqrt_()

    def _halves(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Parts of the square that keep and that change sign half a turn on: (B, H, W / 2), or (B, H, W)."""
        products = torch.view_as_real(vectors[:, :, None] * vectors[:, None, :].conj())
        r = products.flatten(1) @ self.pairs
        even, odd = r[:, : self.count + 1] @ self.even, r[:, self.count + 1 :] @ self.odd
        width = self.width // 2 if self.half_turn else self.width
        return even.view(-1, self.height, width), odd.view(-1, self.height, width)


def _extended_pairs(known: Lags) -> Tensor:
    """(2 (M + 1)^2, 2 L + 1): which products of M + 1 numbers add to which lag number; f^2 goes to both."""
    m, size = known.elements, known.count
    pairs = torch.zeros(m + 1, m + 1, 2, size + 2, dtype=torch.float64)
    half = len(known.difference)
    columns = torch.cat([torch.arange(half), torch.arange(half + 1, size + 1)])
    pairs[:m, :m, 0, columns] = known.real_pairs.view(m, m, -1)
    pairs[:m, :m, 1, columns] = known.imag_pairs.view(m, m, -1)
    pairs[m, m, 0, half] = pairs[m, m, 0, size + 1] = 1.0
    return pairs.flatten(0, 2).float()


def spectra(site: Site, vectors: Tensor) -> Tensor:
    """`|A^H h|` (B, H, W) without shortcuts: what `SpectrumRenderer` must equal where nothing is unknown."""
    assert site.array is not None and site.grid is not None and site.wavelength is not None
    matrix = steering(site.array, site.grid, site.wavelength).to(vectors.dtype)
    return (vectors @ matrix.conj()).abs().view(-1, site.grid.height, site.grid.width)

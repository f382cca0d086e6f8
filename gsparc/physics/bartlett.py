"""Bartlett spectra of a static array from small precomputed matrices."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.ops import SphereGrid
from gsparc.physics.array_response import make_co_array

TINY = 1e-9  # of a squared spectrum: keeps the slope of the square root finite
NEGLIGIBLE = 1e-9  # harmonics this much weaker than the strongest are below float32's resolution


class SpectrumRenderer(nn.Module):
    """`sqrt(|A^H h|^2 + f^2 b^2)`: spectra of array vectors h over an incoherent background b of
    share f.

    The square is linear in the lag numbers of h (response.py), and an array a few wavelengths wide
    sees few harmonics of the azimuth: lag numbers to harmonics of each row, harmonics to pixels.
    For a planar array real lag numbers make the even harmonics and imaginary ones the odd, so that
    half the columns are computed and the others follow by a sign. For 4 x 4 elements on 90 x 360
    pixels this reads 0.6 MB where `A^H h` itself would read 8.3 MB; nothing is approximated.

    Args:
        array: (M, 3) [m] element positions, receiver frame.
        grid: directions of the pixels.
        wavelength: [m].
        background: (H, W) amplitude.
    """

    pairs: Tensor
    square: Tensor

    def __init__(
        self, array: np.ndarray, grid: SphereGrid, wavelength: float, background: Tensor
    ) -> None:
        super().__init__()
        co_array = make_co_array(array, wavelength)
        # Half a turn of azimuth takes d.u to -d.u for elements in a plane: cosines stay,
        # sines change sign.
        planar = float(np.ptp(array[:, 2])) < 1e-6 * wavelength
        self.half_turn = planar and grid.periodic and grid.width % 2 == 0
        pairs = torch.stack([co_array.real_pairs, co_array.imag_pairs], 1).flatten(0, 1)
        self.register_buffer("pairs", pairs.float())
        self.register_buffer("square", background.float().square())
        basis = co_array.spectrum_basis(grid, wavelength).view(grid.height, grid.width, -1)
        count = len(co_array.difference)
        self.spans = [slice(0, count), slice(count, None)] if self.half_turn else [slice(None)]
        columns = grid.width // 2 if self.half_turn else grid.width
        for number, span in enumerate(self.spans):
            table, waves = _harmonics(basis[..., span], columns, grid.periodic)
            self.register_buffer(f"table{number}", table.float().contiguous())
            self.register_buffer(f"waves{number}", waves.float().contiguous())

    def forward(self, vectors: Tensor) -> Tensor:
        """Render spectra (B, H, W) of (B, M + 1) complex64: array vectors and last the share f."""
        parts = self._square_parts(vectors)
        square = (
            torch.cat([parts[0] + parts[1], parts[0] - parts[1]], 2) if self.half_turn else parts[0]
        )
        share = vectors[:, -1].real.square()[:, None, None]
        return (square + share * self.square).clamp_min(TINY).sqrt()

    @property
    def tables(self) -> list[Tensor]:
        """Those of the constructor, as `gsparc.ops.queries.array_spectrum` takes them."""
        names = [
            f"{name}{number}" for number in range(len(self.spans)) for name in ("table", "waves")
        ]
        return [self.pairs, *(getattr(self, name) for name in names)]

    def _square_parts(self, vectors: Tensor) -> list[Tensor]:
        """The coherent square (B, H, W), or what of it stays and what flips half a turn
        on (B, H, W / 2).
        """
        h = vectors[:, :-1]
        products = torch.view_as_real(h[:, :, None] * h[:, None, :].conj())
        r = products.flatten(1) @ self.pairs
        result = []
        for number, span in enumerate(self.spans):
            table, waves = getattr(self, f"table{number}"), getattr(self, f"waves{number}")
            rows = (r[:, span] @ table).view(-1, len(waves))
            result.append((rows @ waves).view(len(vectors), self.square.shape[0], -1))
        return result


def _harmonics(basis: Tensor, columns: int, periodic: bool) -> tuple[Tensor, Tensor]:
    """Lag numbers to harmonics (l, H * K) and harmonics to the first `columns` pixels
    of a row (K, columns).

    Args:
        basis: (H, W, l) float64.
        columns: as wanted.
        periodic: whether the columns close the circle; else pixels are their own harmonics.
    """
    _, width, numbers = basis.shape
    if not periodic:
        return basis.permute(2, 0, 1).reshape(numbers, -1), torch.eye(width, dtype=basis.dtype)
    spectrum = torch.fft.rfft(basis, dim=1) / width
    peak = spectrum.abs().amax((0, 2))
    harmonics = torch.nonzero(peak > NEGLIGIBLE * peak.max()).squeeze(1)
    # `rfft` keeps one of two conjugates: all count twice but the mean and the highest
    # of an even width.
    twice = torch.where((harmonics == 0) | (2 * harmonics == width), 1.0, 2.0).double()
    turn = 2 * torch.pi / width * harmonics[:, None] * torch.arange(columns, dtype=torch.float64)
    waves = torch.stack([twice[:, None] * turn.cos(), -twice[:, None] * turn.sin()], 1).flatten(
        0, 1
    )
    table = torch.view_as_real(spectrum[:, harmonics]).permute(2, 0, 1, 3).reshape(numbers, -1)
    return table, waves

"""A function of direction without a network: the Fourier-Legendre series of GSRF."""

from __future__ import annotations

import torch
from torch import Tensor


def terms(degree: int, order: int) -> int:
    """Number of terms of `fourier_legendre`."""
    return (degree + 1) * (2 * order + 1)


def fourier_legendre(directions: Tensor, degree: int, order: int) -> Tensor:
    """P_l(cos theta) times 1, cos(m phi), sin(m phi): unit vectors (..., 3) -> (..., terms).

    With complex coefficients these span the same functions as P_l(cos theta) exp(j m phi), |m| <= `order`,
    l <= `degree`; theta is measured from z.
    """
    x, y, z = directions.unbind(-1)
    legendre = [torch.ones_like(z), z]
    for n in range(1, degree):  # Bonnet's recursion
        legendre.append(((2 * n + 1) * z * legendre[n] - n * legendre[n - 1]) / (n + 1))
    azimuth = torch.atan2(y, x)
    waves = [torch.ones_like(azimuth)]
    for m in range(1, order + 1):
        waves += [torch.cos(m * azimuth), torch.sin(m * azimuth)]
    series = torch.stack(legendre[: degree + 1], -1).unsqueeze(-1) * torch.stack(waves, -1).unsqueeze(-2)
    return series.flatten(-2)

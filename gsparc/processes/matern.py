"""Correlations of the Matern family, of distances."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ONE = torch.ones(())  # a number would cost each operation of a single query as much again


def matern32(distance: Tensor, length: Tensor | float) -> Tensor:
    """Return the Matern-3/2 correlation of distances (...) [m].

    >>> matern32(torch.tensor([0.0, 2.0]), length=2.0)
    tensor([1.0000, 0.4834])
    """
    # Rasmussen and Williams 2006, eq. 4.17: (1 + s) exp(-s) with s = sqrt(3) d / length.
    scaled = distance * (-math.sqrt(3) / length)
    return torch.sub(ONE, scaled) * scaled.exp()


def matern32_of_squares(squared: Tensor) -> Tensor:
    """Return the Matern-3/2 of squared distances (...) in units of the length,
    with a slope at 0.
    """
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

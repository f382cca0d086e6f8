"""Correlations of wave fields over displacements,
with complex values where waves prefer directions.

The diffuse field of a von Mises-Fisher density of directions with mean u and concentration c is
`c / sinh(c) sinh(z) / z`, `z^2 = c^2 - (k d)^2 + 2 j c k u.d` (N. Ueno, S. Koyama and H.
Saruwatari, "Directionally weighted wave field estimation exploiting prior information on source
direction", IEEE Trans. Signal Process. 69 (2021)); without concentration it is sin(kd) / (kd).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gsparc.physics.waves import NEAR_M
from gsparc.processes.kernel import IsotropicWaves

SMALL = 1e-12  # z whose sinh(z) / z is 1
FLAT_RAD = 0.5  # phase over the height of places, below which waves from above and below look alike


GOLDEN = (1 + math.sqrt(5)) / 2


def squared_exponential(distance: Tensor, length: Tensor | float) -> Tensor:
    """Return the squared exponential of distances [m]."""
    return torch.exp(-0.5 * (distance / length).square())


def directional_correlation(squared: Tensor, along: Tensor, concentration: float) -> Tensor:
    """Return the correlation (...) complex128 of waves that come from about one direction.

    Args:
        squared: (...) float64, (k d)^2 of displacements d.
        along: (...) k d's component towards the direction.
        concentration: about it.
    """
    root = torch.complex(concentration**2 - squared, 2 * concentration * along).sqrt()
    root = torch.where(root.abs() < SMALL, root + SMALL, root)
    return root.sinh() / root * (concentration / math.sinh(concentration))


def isotropic_correlation(
    a: Tensor, b: Tensor, wavenumber: float, length: Tensor | float
) -> Tensor:
    """Return the correlation (..., n, m) float64 of waves from everywhere alike,
    in an envelope [m].

    Where both ends move, waves leave in all directions as they arrive from all:
    the product over the ends.

    Args:
        a, b: (..., n, 3) and (..., m, 3) [m] of one end, or (..., 6) of both.
    """
    return IsotropicWaves(length, wavenumber=wavenumber).covariance(a, b)


def spherical_wave(places: Tensor, source: Tensor, wavenumber: float, reference: Tensor) -> Tensor:
    """Return the wave `reference / r exp(-j k r)` (n,) complex128 at places (n, 3)
    of a source (3,) [m].
    """
    away = ((places - source).square().sum(-1) + NEAR_M**2).sqrt()
    # The amplitude stops growing a quarter of a wavelength away, where no antenna is a point.
    level = reference / (away.square() + (math.pi / 2 / wavenumber) ** 2).sqrt()
    return torch.polar(level, -wavenumber * away)


def fibonacci_sphere(count: int) -> Tensor:
    """Return unit vectors (count, 3) float64, evenly spread (a Fibonacci lattice)."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * number / count, 2 * math.pi * GOLDEN * number
    radius = (1 - height.square()).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], 1)


def spread_directions(places: Tensor, wavenumber: float, count: int) -> Tensor:
    """Return `count` directions (count, 3): of the sphere, or a half where places (n, 3)
    lie in a plane.
    """
    centred = places - places.mean(0)
    few = torch.eye(places.shape[1], dtype=torch.float64)
    axes = torch.linalg.svd(centred, full_matrices=False).Vh if len(places) > 2 else few
    height = (centred @ axes[-1]).abs().max()
    if float(height) * wavenumber > FLAT_RAD:
        return fibonacci_sphere(count)
    half = fibonacci_sphere(2 * count)
    half = half[half[:, 2] > 0]
    # Columns of `basis` are two axes of the plane and its normal.
    basis = torch.stack([axes[0], axes[1], torch.linalg.cross(axes[0], axes[1])], 1)
    return half @ basis.T


def number_cells_by_bisection(places: np.ndarray, depth: int) -> np.ndarray:
    """Return numbers (n,) of 2^depth cells of near places (n, 3), halved across the widest axis."""
    number = np.zeros(len(places), np.int64)
    for _ in range(depth):
        after = number * 2
        for cell in np.unique(number):
            mine = np.flatnonzero(number == cell)
            axis = int(np.ptp(places[mine], axis=0).argmax())
            upper = mine[np.argsort(places[mine, axis], kind="stable")[(len(mine) + 1) // 2 :]]
            after[upper] += 1
        number = after
    return number

"""What Gaussians on a grid take from a path, against numerical quadrature."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.integrate import quad

from gsparc.models.powers.together.terms import crossed, grid

CELLS = torch.tensor([[0.3, -0.2, 0.1], [2.0, 1.0, 0.0], [0.9, 0.1, 0.4]], dtype=torch.float64)
WIDTH = 0.4


def by_quadrature(start: np.ndarray, end: np.ndarray, cell: np.ndarray) -> float:
    def density(t: float) -> float:
        away = (start + t * (end - start) - cell)[:2] / WIDTH
        return math.exp(-0.5 * away @ away)

    length = np.linalg.norm((end - start)[:2])
    return length * quad(density, 0, 1, limit=200)[0] / (math.sqrt(2 * math.pi) * WIDTH)


def test_paths_lose_what_quadrature_finds_along_the_ground():
    ends = np.random.default_rng(0).normal(size=(5, 6))
    found = crossed(torch.from_numpy(ends), CELLS, WIDTH).numpy()
    told = [[by_quadrature(path[:3], path[3:], cell) for cell in CELLS.numpy()] for path in ends]
    assert np.allclose(found, told, rtol=1e-6, atol=1e-9)


def test_the_way_straight_through_counts_one_and_no_way_nothing():
    through = torch.tensor([[-9.0, 0.1, 3.0, 9.5, 0.1, -4.0], [0.3, 0.1, 0, 0.3, 0.1, 0]]).double()
    found = crossed(through, torch.tensor([[0.3, 0.1, 0.0]]).double(), WIDTH)[:, 0]
    assert math.isclose(found[0], 1) and abs(found[1]) < 1e-5


def test_equal_gaussians_of_a_grid_are_flat():
    cells, width = grid(np.zeros(3), np.array([10.0, 8.0, 3.0]), 80)
    middle = torch.tensor([[3.0, 4.0, 1, 7.0, 4.2, 1], [4.0, 2.5, 1, 4.2, 6.5, 1]]).double()
    assert len(cells) <= 80 and torch.allclose(*crossed(middle, cells, width).sum(1), rtol=0.03)

"""Line integrals of Gaussians against numerical quadrature."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.integrate import quad

from gsparc.models.powers.extinction import extinctions, line_integrals

MEANS = torch.tensor([[0.3, -0.2, 0.1], [2.0, 1.0, 0.0], [0.9, 0.1, 0.4]], dtype=torch.float64)
SCALES = torch.tensor([[0.5, 0.2, 0.3], [0.1, 2.0, 1.0], [0.4, 0.4, 0.4]], dtype=torch.float64)
TURNS = torch.tensor([0.0, 0.7, 2.0], dtype=torch.float64)


def by_quadrature(start, end, mean, scale, turn) -> float:
    cos, sin = math.cos(turn), math.sin(turn)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def density(t: float) -> float:
        own = axes @ (start + t * (end - start) - mean) / scale
        return math.exp(-0.5 * own @ own)

    return np.linalg.norm(end - start) * quad(density, 0, 1, limit=200)[0]


def test_line_integrals_are_those_of_quadrature():
    ends = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 5, 3)))
    found = line_integrals(*ends, MEANS, SCALES, TURNS)
    for i in range(5):
        for k in range(3):
            parts = (ends[0, i], ends[1, i], MEANS[k], SCALES[k])
            told = by_quadrature(*(part.numpy() for part in parts), float(TURNS[k]))
            assert math.isclose(float(found[i, k]), told, rel_tol=1e-6, abs_tol=1e-9)


def test_slopes_are_those_of_differences():
    ends = torch.from_numpy(np.random.default_rng(1).normal(size=(2, 4, 3)))
    scales = (SCALES + torch.tensor([0.0, 0.01, 0.02])).log()  # the shortest of equal ones has no slope
    arguments = tuple(part.clone().requires_grad_() for part in (*ends, MEANS, scales, TURNS))
    assert torch.autograd.gradcheck(extinctions, arguments)


def test_a_path_straight_through_a_wall_counts_one():
    start, end = torch.tensor([[-9.0, 0, 0]]).double(), torch.tensor([[9.0, 0, 0]]).double()
    wall = torch.tensor([[0.1, 5.0, 3.0]]).double().log()
    none = torch.zeros(1, dtype=torch.float64)
    assert torch.allclose(extinctions(start, end, none.view(1, 1).expand(1, 3), wall, none), none + 1)


def test_a_path_without_length_loses_nothing():
    point = torch.zeros(1, 3, dtype=torch.float64)
    assert float(extinctions(point, point, MEANS, SCALES.log(), TURNS).abs().max()) < 1e-9

"""Known walls and floors that straight paths cross."""

from __future__ import annotations

import numpy as np
import torch

from gsparc.data.walls import SceneWalls
from gsparc.models.image_sources.known.images import walls_of_file

WALL = np.array([[2.0, -3, 0], [2, 3, 0], [2, 3, 3], [2, -3, 3]])
FLOOR = np.array([[-5.0, -5, 3], [5, -5, 3], [5, 5, 3], [-5, 5, 3]])
BOX = np.array([[[0.0, 5, 0], [1, 6, 2]]])


def test_walls_floors_and_both_sides_of_a_box_are_counted():
    walls = walls_of_file(SceneWalls((WALL, FLOOR), BOX), np.array([0.0, 0, 1]), np.array([0.0, 0, 0.5]))
    ends = [[4, 0, 0.5], [9, 20, 0.5], [1, 0.5, 0.5], [0.5, 0, 3], [0.6, 9, 0.5], [0, 0, 0.5], [2, 0, 0.5]]
    found = walls.columns(torch.tensor(ends, dtype=torch.float64))
    assert found.tolist() == [[1, 0], [0, 0], [0, 0], [0, 1], [2, 0], [0, 0], [0, 0]]


def test_either_end_of_a_path_may_move():
    walls = walls_of_file(SceneWalls((WALL,), BOX[:0]), np.zeros(3), None)
    both = torch.tensor([[0.0, 0, 1, 4, 0, 1], [4, 0, 1, 0, 0, 1], [0, 0, 1, 1, 0, 1]], dtype=torch.float64)
    assert walls.columns(both)[:, 0].tolist() == [1, 1, 0]


def test_a_place_beside_a_long_wall_crosses_it_once_at_most():
    """As Gaussians walls took the way inside them: a place beside a wall of 28 m was 126 dB too dark."""
    walls = walls_of_file(SceneWalls((WALL * [1, 5, 1],), BOX[:0]), np.zeros(3), np.array([1.95, -14.0, 1.5]))
    assert walls.columns(torch.tensor([[2.05, 14.0, 1.5]], dtype=torch.float64)).tolist() == [[1, 0]]

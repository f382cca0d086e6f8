"""Walls and boxes on the straight line between two places."""

from __future__ import annotations

import numpy as np
import pytest

from gsparc.data.walls import SceneWalls
from gsparc.view.crossed import Obstacles

NO_BOXES = np.zeros((0, 2, 3))


def wall(x: float, high: float = 3.0) -> np.ndarray:
    """A wall across x, 4 m wide and `high` metres tall."""
    return np.array([[x, -2, 0], [x, 2, 0], [x, 2, high], [x, -2, high]], np.float64)


def crossed(start, end, faces=(), boxes=NO_BOXES) -> int:
    walls = Obstacles.of(SceneWalls(tuple(faces), np.asarray(boxes, np.float64)))
    return walls.crossed(np.array(start, np.float64), np.array(end, np.float64))


def test_walls_between_two_places_are_counted_and_others_not():
    walls = [wall(1), wall(2), wall(5), wall(3, high=1.0)]
    assert crossed([0, 0.1, 1.5], [4, 0.1, 1.5], walls) == 2
    assert crossed([4, 0.1, 1.5], [0, 0.1, 1.5], walls) == 2
    assert crossed([0, 0.1, 0.5], [6, 0.1, 0.5], walls) == 4
    assert crossed([0, 3, 1.5], [4, 3, 1.5], walls) == 0  # past their ends
    assert crossed([0, 0, 1.5], [0, 0, 1.5], walls) == 0


def test_the_diagonal_of_a_face_belongs_to_one_of_its_triangles():
    assert crossed([0, 0, 1.5], [2, 0, 1.5], [wall(1)]) == 1


def test_both_sides_of_a_wall_are_one_wall():
    assert crossed([0, 0.1, 1.5], [4, 0.1, 1.5], [wall(1), wall(1.2)]) == 1


def test_a_face_that_is_not_convex_is_passed_beside_its_notch():
    notched = np.array([[0, 0, 0], [0, 4, 0], [0, 4, 4], [0, 2, 1], [0, 0, 4]], np.float64)
    assert crossed([-1, 2, 3], [1, 2, 3], [notched]) == 0
    assert crossed([-1, 0.5, 2], [1, 0.5, 2], [notched]) == 1


@pytest.mark.parametrize(
    ("end", "count"), [([4, 0, 0], 1), ([0.5, 0, 0], 0), ([1.5, 0, 0], 1), ([0, 4, 0], 0)]
)
def test_boxes_are_counted_once_whether_the_line_leaves_them_or_not(end, count):
    assert crossed([0, 0, 0], end, boxes=[[[1, -1, -1], [2, 1, 1]]]) == count

"""Walls and boxes on the straight line between two places."""

import numpy as np
import pytest

from gsparc.apps.view.crossed import Obstacles
from gsparc.data.walls import SceneWalls

NO_BOXES = np.zeros((0, 2, 3))


def wall(x: float, high: float = 3.0) -> np.ndarray:
    """A wall across x, 4 m wide and `high` metres tall."""
    return np.array([[x, -2, 0], [x, 2, 0], [x, 2, high], [x, -2, high]], np.float64)


NOTCHED = np.array([[0, 0, 0], [0, 4, 0], [0, 4, 4], [0, 2, 1], [0, 0, 4]], np.float64)
WALLS = [wall(1), wall(2), wall(5), wall(3, high=1.0)]
BOX = [[[1, -1, -1], [2, 1, 1]]]


@pytest.mark.parametrize("start, end, faces, boxes, count", [
    ([0, 0.1, 1.5], [4, 0.1, 1.5], WALLS, NO_BOXES, 2),
    ([4, 0.1, 1.5], [0, 0.1, 1.5], WALLS, NO_BOXES, 2),
    ([0, 0.1, 0.5], [6, 0.1, 0.5], WALLS, NO_BOXES, 4),
    ([0, 3, 1.5], [4, 3, 1.5], WALLS, NO_BOXES, 0),  # past their ends
    ([0, 0, 1.5], [0, 0, 1.5], WALLS, NO_BOXES, 0),
    ([0, 0, 1.5], [2, 0, 1.5], [wall(1)], NO_BOXES, 1),  # the diagonal belongs to one of its triangles
    ([0, 0.1, 1.5], [4, 0.1, 1.5], [wall(1), wall(1.2)], NO_BOXES, 1),  # both sides of one
    ([-1, 2, 3], [1, 2, 3], [NOTCHED], NO_BOXES, 0),
    ([-1, 2, 1.5], [1, 2, 1.5], [NOTCHED], NO_BOXES, 0),  # in the notch two triangles of its fan are hit
    ([-1, 0.5, 2], [1, 0.5, 2], [NOTCHED], NO_BOXES, 1),
    ([0, 0, 0], [4, 0, 0], [], BOX, 1),  # once, whether the line leaves it or not
    ([0, 0, 0], [0.5, 0, 0], [], BOX, 0),
    ([0, 0, 0], [1.5, 0, 0], [], BOX, 1),
    ([0, 0, 0], [0, 4, 0], [], BOX, 0),
])  # fmt: skip
def test_walls_and_boxes_between_two_places_are_counted(start, end, faces, boxes, count):
    walls = Obstacles.of(SceneWalls(tuple(faces), np.asarray(boxes, np.float64)))
    assert walls.crossed(np.array(start, np.float64), np.array(end, np.float64)) == count

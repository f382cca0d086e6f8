"""Faces joined to planes and rectangles, images in them against the simulator's,
walls that paths cross.
"""

import numpy as np
import pytest
import torch
from rooms import PILLAR, shoebox

from gsparc.data.walls import SceneWalls, box_faces
from gsparc.models.image_sources.clutter.blocking import visible_share
from gsparc.models.image_sources.clutter.unfold import Unfolding
from gsparc.models.image_sources.known.images import Mirrors, walls_in_frame
from gsparc.physics.mirror_planes import images

ROOM = SceneWalls(tuple(box_faces(np.zeros(3), np.array([4.0, 3.0, 2.5]))), PILLAR)


def scene(order: int, most: int = 200, walls: SceneWalls = ROOM, hidden: bool = True):
    told, _, _ = shoebox(80, pillar=True, max_order=order)
    mirrors = Mirrors.from_walls(walls, np.zeros(3))
    transmitter, places = torch.from_numpy(told.tx[0]), torch.from_numpy(told.rx)
    indices = mirrors.large_planes(0.25)
    return (
        told,
        mirrors,
        mirrors.visible_sequences(indices, transmitter, places, order, most, hidden),
    )


def test_all_images_are_the_simulators_and_as_visible():
    told, mirrors, sequences = scene(3)
    transmitter = torch.from_numpy(told.tx[0])
    found = images(transmitter, mirrors.planes, sequences).numpy()
    true = told.images.mirror_points(told.tx[0])
    apart = np.linalg.norm(found[:, None] - true[None], axis=-1)
    assert (
        sequences[0] == ()
        and (apart.min(1) < 1e-6).all()
        and len(set(apart.argmin(1))) == len(sequences)
    )
    assert (
        np.abs(told.visible.mean(0)[np.setdiff1d(np.arange(len(true)), apart.argmin(1))]).max(
            initial=0
        )
        < 0.05
    )
    paths = Unfolding(transmitter, mirrors.planes, sequences).paths(torch.from_numpy(told.rx))
    seen = visible_share(paths, mirrors.clutter, mirrors.planes) > 0.5
    assert (seen.numpy() == told.visible[:, apart.argmin(1)].T).mean() > 0.97


def test_the_strongest_are_kept_and_come_first():
    _, _, few = scene(2, most=8)
    assert len(few) == 8 and few[0] == () and all(len(sequence) == 1 for sequence in few[1:5])
    assert scene(2, most=1)[2] == ((),)


def test_a_wall_that_reflects_to_nobody_has_no_image_but_hides():
    """A small plate beside the transmitter: its shadow falls on receivers,
    its reflections do not.
    """
    told, _, _ = shoebox(80, max_order=1)
    plate = told.tx[0] + np.array([[0.3, -1, -1], [0.3, 1, -1], [0.3, 1, 1], [0.3, -1, 1.0]])
    walls = SceneWalls((plate,), PILLAR[:0])
    mirrors = Mirrors.from_walls(walls, np.zeros(3))
    far = torch.from_numpy(told.rx[told.rx[:, 0] > told.tx[0, 0] + 0.5])
    transmitter = torch.from_numpy(told.tx[0])
    sequences = mirrors.visible_sequences([0], transmitter, far, 2, 20, True)
    assert (
        sequences == ((),) and len(mirrors.obstacles_of(sequences, transmitter, far).patches) == 1
    )
    assert len(mirrors.visible_sequences([0], transmitter, far, 2, 20, False)) == 2
    behind = far + torch.tensor([-100.0, 0, 0])
    assert len(mirrors.obstacles_of(sequences, transmitter, behind).patches) == 0


NOTHING = np.zeros((0, 2, 3))


def split(face: np.ndarray) -> list[np.ndarray]:
    return [face[[0, 1, 2]], face[[0, 2, 3]]]


def test_triangles_of_a_box_are_six_planes_with_a_rectangle_each():
    faces = [
        part for face in box_faces(np.zeros(3), np.array([4.0, 3.0, 2.5])) for part in split(face)
    ]
    whole = Mirrors.from_walls(SceneWalls(tuple(faces), NOTHING), np.array([1.0, 1.0, 1.0]))
    assert len(whole.planes) == 6 and sorted(whole.clutter.plane) == [0, 1, 2, 3, 4, 5]
    assert sorted(whole.planes[:, 3].abs().tolist()) == pytest.approx([1, 1, 1, 1.5, 2, 3])
    sides = whole.clutter.patches[:, 2:] - whole.clutter.patches[:, :2]
    assert sides.prod(1).sum() == pytest.approx(2 * (12 + 10 + 7.5), rel=1e-5)


WALL = np.array([[2.0, -3, 0], [2, 3, 0], [2, 3, 3], [2, -3, 3]])
FLOOR = np.array([[-5.0, -5, 3], [5, -5, 3], [5, 5, 3], [-5, 5, 3]])
BOX = np.array([[[0.0, 5, 0], [1, 6, 2]]])


def test_walls_floors_and_both_sides_of_a_box_are_counted():
    walls = walls_in_frame(
        SceneWalls((WALL, FLOOR), BOX), np.array([0.0, 0, 1]), np.array([0.0, 0, 0.5])
    )
    ends = [
        [4, 0, 0.5],
        [9, 20, 0.5],
        [1, 0.5, 0.5],
        [0.5, 0, 3],
        [0.6, 9, 0.5],
        [0, 0, 0.5],
        [2, 0, 0.5],
    ]
    found = walls.columns(torch.tensor(ends, dtype=torch.float64))
    assert found.tolist() == [[1, 0], [0, 0], [0, 0], [0, 1], [2, 0], [0, 0], [0, 0]]


def test_a_place_beside_a_long_wall_crosses_it_once_at_most():
    """As Gaussians walls took the way inside them:
    a place beside a wall of 28 m was 126 dB too dark.
    """
    walls = walls_in_frame(
        SceneWalls((WALL * [1, 5, 1],), BOX[:0]), np.zeros(3), np.array([1.95, -14.0, 1.5])
    )
    assert walls.columns(torch.tensor([[2.05, 14.0, 1.5]], dtype=torch.float64)).tolist() == [
        [1, 0]
    ]

"""Faces joined to planes and rectangles."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsparc.data.walls import SceneWalls, box_faces
from gsparc.models.image_sources.known import images as mirrors
from gsparc.models.image_sources.known.images import Mirrors

NOTHING = np.zeros((0, 2, 3))


def split(face: np.ndarray) -> list[np.ndarray]:
    return [face[[0, 1, 2]], face[[0, 2, 3]]]


def test_triangles_of_a_box_are_six_planes_with_a_rectangle_each():
    faces = [part for face in box_faces(np.zeros(3), np.array([4.0, 3.0, 2.5])) for part in split(face)]
    whole = Mirrors.of(SceneWalls(tuple(faces), NOTHING), np.array([1.0, 1.0, 1.0]))
    assert len(whole.planes) == 6 and sorted(whole.clutter.plane) == [0, 1, 2, 3, 4, 5]
    assert sorted(whole.planes[:, 3].abs().tolist()) == pytest.approx([1, 1, 1, 1.5, 2, 3])
    sides = whole.clutter.patches[:, 2:] - whole.clutter.patches[:, :2]
    assert sides.prod(1).sum() == pytest.approx(2 * (12 + 10 + 7.5), rel=1e-5)


def test_walls_of_one_plane_that_do_not_touch_are_apart():
    one = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 2], [0, 0, 2.0]])
    moved = [np.array([3, 0, 0]), np.array([5, 0.005, 0])]
    found = Mirrors.of(SceneWalls((one, one + moved[0], one[::-1] + moved[1]), NOTHING), np.zeros(3))
    assert len(found.planes) == 1 and found.clutter.plane == (0, 0, 0)
    assert found.mirroring(0.5) == [0] and found.mirroring(1.5) == []


def test_of_a_fine_mesh_the_smallest_are_left_out(monkeypatch):
    monkeypatch.setattr(mirrors, "MOST_PATCHES", 2)
    faces = tuple(np.eye(3) * size + size * 10 for size in (1.0, 2.0, 3.0))
    found = Mirrors.of(SceneWalls(faces, NOTHING), np.zeros(3))
    assert found.left_out == 1 and len(found.clutter.patches) == 2
    assert torch.isfinite(found.clutter.patches).all()

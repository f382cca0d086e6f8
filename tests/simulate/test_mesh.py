import numpy as np

from gsparc.data.walls import area, read_walls
from gsparc.simulate.scenes.solid import box, write_mesh


def test_a_mesh_is_read_back_as_walls(tmp_path):
    solid = box("hut", "brick", (1, 2, 0), (4, 4, 3), turn=0.3)
    write_mesh(solid.vertices[solid.faces], tmp_path / "scene.obj")
    walls = read_walls(tmp_path / "scene.obj")
    assert len(walls) == 12
    np.testing.assert_allclose(sum(map(area, walls.faces)), 2 * (6 + 9 + 6), atol=0.02)
    corners = np.unique(np.concatenate(walls.faces), axis=0)
    assert len(corners) == 8
    np.testing.assert_allclose(np.sort(corners, 0), np.sort(solid.vertices, 0), atol=6e-4)

"""Walls out of files: simulated rooms, lists of corners, meshes, and what cannot be."""

import dataclasses
from pathlib import Path

import pytest

from gsparc.data.walls import SIMULATED, polygon_area, read_walls
from gsparc.simulate.scenes.settings import SceneSettings

SCENES = Path(__file__).parents[2] / "conf" / "scene"


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_simulated_room_is_a_file_of_walls():
    found = read_walls(SCENES / "shoebox.yaml")
    assert len(found.faces) == 6 and found.boxes.shape == (1, 2, 3)
    assert sum(map(polygon_area, found.faces)) == pytest.approx(2 * (6 * 5 + 6 * 3 + 5 * 3))
    assert {tuple(face.min(0)) for face in found.faces} >= {
        (0, 0, 0),
        (6, 0, 0),
        (0, 5, 0),
        (0, 0, 3),
    }


def test_other_keys_of_simulated_scenes_are_known():
    assert {field.name for field in dataclasses.fields(SceneSettings)} - {"room"} == SIMULATED


def test_walls_are_polygons(tmp_path):
    text = "walls:\n- {corners_m: [[0, 0, 0], [4, 0, 0], [4, 0, 3], [0, 0, 3]]}\n"
    text += "- [[0, 0, 0], [0, 2, 0], [0, 2, 2]]"
    found = read_walls(written(tmp_path / "a.yaml", text))
    assert [polygon_area(face) for face in found.faces] == [12.0, 2.0] and len(found.boxes) == 0


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.ply", "ply", r"a\.ply: walls are read from \*\.yaml; write a mesh's faces as `walls`"),
        ("a.yaml", "{}", r"a\.yaml: no walls in it; expected `walls`"),
        ("a.yaml", "wals: []", r"wals: no such key; did you mean 'walls'\?"),
        ("a.yaml", "room: {size_m: [4, 3]}", r"room\.size_m=\[4, 3\]: .*three lengths above 0"),
        (
            "a.yaml",
            "room: {boxes_m: [[[1, 1, 1], [0, 2, 2]]]}",
            r"room\.boxes_m=.*lower corner first",
        ),
        ("a.yaml", "room: {hight: 3}", r"a\.yaml: room\.hight: no such setting"),
        ("a.yaml", "walls: [{corners_m: [[0, 0, 0], [1, 1]]}]", r"walls\[0\]: expected corners_m"),
        (
            "a.yaml",
            "walls: [[[0, 0, 0], [1, 0, 0], [2, 0, 0]]]",
            r"walls\[0\]: its corners lie on a line",
        ),
        (
            "a.yaml",
            "walls: [[[0,0,0],[1,0,0],[1,1,1],[0,1,0]]]",
            r"walls\[0\]: .* off a plane; split it",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(name, text, said, tmp_path, refused):
    refused(said, read_walls, written(tmp_path / name, text))


def test_a_missing_file_is_named(tmp_path, refused):
    refused(r"absent\.yaml: missing; expected", read_walls, tmp_path / "absent.yaml")
    refused(r"init\.file is missing; expected a file of `walls`", read_walls, None)

"""Where a map lies: rectangles, polygons, floor plans; what cannot be is refused in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from towns import town_model

import gsparc
from gsparc.data.errors import DataError
from gsparc.data.links.georeference import Georeference
from gsparc.maps import map_of
from gsparc.maps.area import grid_of
from gsparc.maps.floor_plan import read_plan
from gsparc.maps.geojson import read_shapes


def geojson(path, kind="Polygon", coordinates=None):
    square = [[[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], [[4, 4], [6, 4], [6, 6], [4, 6], [4, 4]]]
    path.write_text(json.dumps({"type": kind, "coordinates": square if coordinates is None else coordinates}))
    return path


def image(path, size=(200, 100)):
    Image.new("RGB", size, "white").save(path)
    return path


def test_a_rectangle_is_covered_by_square_cells():
    grid = grid_of(None, [0, 0, 4, 3], 1.5, 0.5)
    assert grid.shape == (6, 8) and grid.inside.all() and grid.extent == (0.0, 4.0, 0.0, 3.0)
    assert grid.places().shape == (48, 3) and (grid.places()[:, 2] == 1.5).all()
    assert grid.places(np.array([8]))[0].tolist() == [0.25, 0.75, 1.5]


def test_a_polygon_keeps_its_holes(tmp_path):
    grid = grid_of(None, str(geojson(tmp_path / "a.geojson")), 1.5, 0.5)
    assert grid.inside.sum() == 400 - 16
    assert not grid.inside[9, 9] and grid.inside[0, 0]


def test_degrees_are_those_of_the_model(tmp_path):
    origin = Georeference(47.0, 11.0)
    square = [[[11.0, 47.0], [11.001, 47.0], [11.001, 47.001], [11.0, 47.001]]]
    low, high = read_shapes(geojson(tmp_path / "a.json", coordinates=square), "area", origin).bounds()
    assert np.allclose(low, 0, atol=1e-6) and np.allclose(high, [76.06, 111.2], rtol=1e-3)


def test_a_plan_lies_where_its_two_points_say(tmp_path):
    plan = read_plan(image(tmp_path / "p.png"), [[0, 100, 5, 1], [200, 100, 25, 1]])  # 10 pixels a metre
    assert np.allclose(plan.corners(), [[5, 11], [25, 11], [25, 1], [5, 1]])
    turned = read_plan(tmp_path / "p.png", [[0, 0, 0, 0], [100, 0, 0, 10]])  # its right is north
    assert np.allclose(turned.corners()[1], [0, 20]) and np.allclose(turned.corners()[3], [10, 0])
    grid = grid_of(None, None, 1.5, 1.0, plan)
    assert grid.inside.sum() == 200


SPOILT_AREAS = {
    "x1 must be above": [3, 0, 1, 2],
    "expected \\[x0,y0,x1,y1\\]": [1, 2, 3],
    "no coordinate in metres": [0, 0, 1e9, 1],
    "no such file": "missing.geojson",
    "or a \\*.geojson file": "area.txt",
    "expected \\[x0,y0,x1,y1\\] in": [0, 0, "nan", 1],
}


@pytest.mark.parametrize("said", SPOILT_AREAS)
def test_spoilt_areas(said):
    with pytest.raises(DataError, match=said) as caught:
        grid_of(None, SPOILT_AREAS[said], 1.5, 0.5)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [2, 2], [0, 0]]]}', "empty polygon"),
        ('{"type": "Polygon", "coordinates": []}', "no polygon|corners"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], ["a", 1], [2, 2]]]}', "pairs of numbers"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1, 1]]}', "no polygon"),
        ('{"type": "FeatureCollection", "features": []}', "no polygon"),
        ("not json", "not readable"),
        ("[1, 2]", "not GeoJSON"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [NaN, 1], [2, 2]]]}', "NaN"),
    ],
)
def test_spoilt_polygons(tmp_path, content, said):
    path = tmp_path / "a.geojson"
    path.write_text(content)
    with pytest.raises(DataError, match=said) as caught:
        grid_of(None, str(path), 1.5, 0.5)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"step_m": 0}, "above 0"),
        ({"step_m": -1.0}, "above 0"),
        ({"step_m": 1e-4, "area": [0, 0, 1e5, 1e5]}, "memory"),
        ({"height_m": float("nan")}, "finite"),
        ({"area": None}, "nothing says where"),
    ],
)
def test_spoilt_grids(how, said):
    with pytest.raises(DataError, match=said):
        grid_of(None, **{"area": [0, 0, 4, 4], "height_m": 1.5, **how})


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (None, "has no scale"),
        ([[0, 0, 0, 0]], "two points"),
        ([[5, 5, 0, 0], [5, 5, 9, 9]], "no scale"),
        ([[0, 0, 1, 1], [50, 50, 1, 1]], "one place"),
        ([[0, 0, 1, "x"], [50, 50, 1, 1]], "two points"),
    ],
)
def test_spoilt_plans(tmp_path, points, said):
    with pytest.raises(DataError, match=said):
        read_plan(image(tmp_path / "p.png"), points)


def test_a_plan_that_is_no_image(tmp_path):
    (tmp_path / "p.png").write_text("hello")
    with pytest.raises(DataError, match="not an image"):
        read_plan(tmp_path / "p.png", [[0, 0, 0, 0], [9, 9, 9, 9]])
    with pytest.raises(DataError, match="no such file"):
        read_plan(tmp_path / "q.png", None)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"stations": ["nord"]}, "no station 'nord'"),
        ({"stations": []}, "name one"),
        ({"load": 1.5}, "0 to 1"),
        ({"load": [1, 1, 1]}, "one per station"),
        ({"load": {"south": 1}}, "no station 'south'"),
        ({"other_end": [0, 0, 1]}, "stood still"),
        ({"step_m": 0}, "above 0"),
        ({"area": [0, 0, 0, 0]}, "is empty"),
    ],
)
def test_spoilt_maps(how, said):
    with pytest.raises(DataError, match=said) as caught:
        map_of(gsparc.load(town_model()), **{"step_m": 5.0, **how})
    assert "\n" not in str(caught.value)

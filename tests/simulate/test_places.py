"""Transmitters with sectors; receivers on a grid, along lines and out of files;
objects as a mesh.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused

from gsparc.data.georeference import Georeference
from gsparc.data.walls import polygon_area, read_walls
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.scenes.receivers import (
    choose_farthest_rows,
    nearest_rows,
    place_receivers,
    sample_positions,
)
from gsparc.simulate.scenes.settings import Layout
from gsparc.simulate.scenes.solid import box, write_walls
from gsparc.simulate.scenes.transmitters import place_transmitters

AREA = np.array([[0.0, 0.0], [20.0, 10.0]])
SOMEWHERE = Georeference(40.0, -30.0)


class Hut:
    """Ground at z = 5 with a hut of 4 x 4 m in the corner."""

    def lift(self, points):
        return points + np.array([0, 0, 5.0])

    def allowed(self, points):
        return ~((points[:, 0] < 4) & (points[:, 1] < 4))


def laid(georeference=None, streets=(), **settings):
    asked = {"num_receivers": 30, "height_m": (1.0, 2.0), "seed": 0}
    on_map = georeference is not None or len(streets)
    town = SimpleNamespace(georeference=georeference, streets=streets) if on_map else None
    return place_receivers(SimpleNamespace(layout=Layout(**settings), **asked), AREA, Hut(), town)


def test_sectors_are_stations_at_equal_angles():
    entries = [
        {
            "name": "mast",
            "position_m": [1, 2, 30],
            "sectors": 3,
            "azimuth_deg": 300,
            "downtilt_deg": 6,
        },
        {"position_m": [5, 5], "height_m": 2},
        {"name": "b", "position_deg": [40.001, -30.0], "height_m": 1.5, "pattern": "dipole"},
    ]
    found = place_transmitters(entries, lambda across: np.full(len(across), 7.0), SOMEWHERE)
    assert [one.name for one in found] == ["mast-1", "mast-2", "mast-3", "tx1", "b"]
    assert [one.antenna.azimuth_deg for one in found[:3]] == [300, 60, 180]
    assert {one.antenna.pattern for one in found[:3]} == {"tr38901"} and found[
        3
    ].antenna.pattern == "iso"
    np.testing.assert_allclose(found[3].position, [5, 5, 9])
    np.testing.assert_allclose(found[4].position, [0, 111.03, 8.5], atol=0.02)


def test_a_third_coordinate_beside_degrees_was_ignored():
    (found,) = place_transmitters(
        [{"position_deg": [40.001, -30.0, 12.0], "height_m": 3}], None, SOMEWHERE
    )
    np.testing.assert_allclose(found.position, [0, 111.03, 12.0], atol=0.02)


def test_grid_leaves_out_occupied_places():
    found = laid(kind="grid", spacing_m=2.0)
    assert len(found.places) == 11 * 6 - 4 and found.time_s is None
    assert (found.places[:, 2] >= 6).all() and (found.places[:, 2] <= 7).all()
    refused(
        r"4 of 66 receivers .*\(0\.0, 0\.0\)", laid, kind="grid", spacing_m=2.0, inside="refuse"
    )


def test_streets_are_sampled_evenly():
    streets = [np.array([[-5.0, 9.0], [30.0, 9.0]]), np.array([[10.0, 0.0], [10.0, 8.0]])]
    found = laid(streets=streets, kind="streets", spacing_m=2.0)
    assert (
        (found.places[:, :2] >= 0).all()
        and (found.places[:, 0] <= 20).all()
        and len(found.places) == 15
    )


def test_receivers_of_a_table_in_degrees_with_times(tmp_path):
    east, north = np.array([6.0, 12.0, 18.0]), np.array([5.0, 5.0, 5.0])
    latitude, longitude = SOMEWHERE.to_degrees(np.stack([east, north], 1))
    rows = [
        f"{a:.8f},{b:.8f},1.5,{t}" for a, b, t in zip(latitude, longitude, (0, 2, 5), strict=True)
    ]
    (tmp_path / "walk.csv").write_text("\n".join(["latitude,longitude,height,time_s", *rows]))
    found = laid(SOMEWHERE, kind="file", file=str(tmp_path / "walk.csv"))
    np.testing.assert_allclose(found.places, np.stack([east, north, np.full(3, 6.5)], 1), atol=0.01)
    np.testing.assert_allclose(found.time_s, [0, 2, 5])
    refused("nowhere on Earth", laid, kind="file", file=str(tmp_path / "walk.csv"))
    (tmp_path / "hut.csv").write_text("x,y,z\n6,6,1\n7,7,1\n1,1,1\n")
    with pytest.raises(
        ValueError, match="1 of 3 receivers stand in or on something, the first at row 2"
    ):
        laid(kind="file", file=str(tmp_path / "hut.csv"))
    assert len(laid(kind="file", file=str(tmp_path / "hut.csv"), inside="drop").places) == 2


@pytest.mark.parametrize("cell, words", [("noon", "finite number"), ("", "line 3: no number")])
def test_bad_times_are_refused(cell, words, tmp_path):
    (tmp_path / "walk.tsv").write_text(f"x\ty\tz\ttime_s\n6\t5\t1\t0\n7\t5\t1\t{cell}\n")
    refused(words, laid, kind="file", file=str(tmp_path / "walk.tsv"))


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"kind": "circle"}, "circle': one of area"),
        ({"inside": "maybe"}, "one of drop, refuse"),
        ({"kind": "grid", "spacing_m": 0.0}, "spacing_m=0.0: a number above 0"),
        ({"kind": "grid", "spacing_m": 1e-4}, "places"),
        ({"kind": "streets"}, "no streets"),
        ({"kind": "file"}, "file is missing"),
        ({"kind": "file", "file": "nowhere.csv"}, "nowhere.csv"),
    ],
)
def test_bad_receivers_are_refused(settings, words):
    refused(words, laid, **settings)


def test_many_places_are_found_where_few_are_allowed():
    """Draws were 204,800 whatever was asked for: 100,000 did not fit where half is built on."""
    found = sample_positions(2_500, AREA, (1.0, 2.0), lambda points: points[:, 0] < 0.2, 0)
    assert len(found) == 2_500 and (found[:, 0] < 0.2).all()
    refused(
        "0 of 20 receivers",
        sample_positions,
        20,
        AREA,
        (1.0, 2.0),
        lambda points: points[:, 0] < 0,
        0,
    )


def test_mesh_is_read_back_as_walls(tmp_path):
    solid = box("hut", "brick", (1, 2, 0), (4, 4, 3), turn=0.3)
    write_walls(solid.vertices[solid.faces], tmp_path / "walls.yaml")
    walls = read_walls(tmp_path / "walls.yaml")
    assert len(walls) == 12
    np.testing.assert_allclose(sum(map(polygon_area, walls.faces)), 2 * (6 + 9 + 6), atol=0.02)
    corners = np.unique(np.concatenate(walls.faces), axis=0)
    assert len(corners) == 8
    np.testing.assert_allclose(np.sort(corners, 0), np.sort(solid.vertices, 0), atol=6e-4)


def test_places_that_repeat_were_drawn_again_and_neighbours_of_themselves():
    """Probes of a receiver that stands still were also those
    that their effects were verified on.
    """
    places = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [5, 0, 0]])
    assert sorted(choose_farthest_rows(places, 4, seed=0)) == [0, 1, 2, 3]
    rows = np.arange(3)
    assert (nearest_rows(places, rows) != rows).all()


def test_the_sky_over_an_area_beside_the_scene_was_the_mean_of_nothing():
    empty = SimpleNamespace(
        bounding_box=lambda: np.zeros((2, 3)),
        surface_height=lambda across: np.full(len(across), -np.inf),
    )
    with pytest.raises(ValueError, match="nothing of the scene is there"):
        RayTracer.has_open_sky(empty, np.array([[500.0, 500.0], [600.0, 600.0]]))

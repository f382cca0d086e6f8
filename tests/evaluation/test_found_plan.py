"""The map of what a field found: everything on it is named, and stands where it is."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from gsparc.data.own import from_arrays
from gsparc.data.site_objects import SiteObjects
from gsparc.data.walls import SceneWalls
from gsparc.evaluation import site_plan
from gsparc.evaluation.site_plan import draw_found

STATION = np.array([101.0, 204.0, 2.0])
HALF = np.sqrt(0.5)
PLANES = np.array([[1.0, 0, 0, 5.0], [HALF, HALF, 0, 2.0], [0, 0, 1.0, -1.0]])  # two walls, and a floor
BOX = np.array([[[1.0, 1.0, -1.0], [2.0, 3.0, 0.0]]])


@pytest.fixture
def room():
    """Powers of a room far from the origin of its coordinates."""
    places = np.random.default_rng(0).uniform([100, 200, 1], [108, 206, 1.1], (60, 3))
    arrays = {"rx_position": places, "tx_position": STATION, "rssi_db": np.linspace(-60, -40, 60)}
    return from_arrays(arrays, {"name": "room"})


def drawn(monkeypatch, data, objects, known=None) -> Figure:
    kept: list[Figure] = []
    monkeypatch.setattr(site_plan, "save", lambda figure, path: kept.append(figure))
    draw_found(data, objects, "unused.png", known)
    kept[0].draw_without_rendering()
    return kept[0]


def test_walls_and_boxes_are_drawn_where_they_are(room, monkeypatch):
    corners = np.array([[100.0, 200, 0], [108, 200, 0], [108, 200, 3], [100, 200, 3]])
    known = SceneWalls((corners,), BOX + room.site.origin)
    figure = drawn(monkeypatch, room, SiteObjects.from_arrays(PLANES, BOX), known)
    lines = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    np.testing.assert_allclose(lines["mirror planes found"][:, 0], 5.0 + room.site.origin[0])
    np.testing.assert_allclose(lines["known walls"], [[108, 200], [100, 200]])
    np.testing.assert_allclose(lines["ends that stand"], STATION[None, :2])
    assert {text.get_text() for text in figure.legends[0].get_texts()} == {
        "measured places", "known walls", "known boxes", "mirror planes found", "boxes found (1)",
        "ends that stand",
    }  # fmt: skip
    assert f"z = {room.site.origin[2] - 1.0:.2f} m" in figure.get_suptitle()


def test_a_wall_apart_from_all_places_was_beside_the_map(room, monkeypatch):
    apart = np.array([[1.0, 0, 0, 25.0], [1.0, 0, 0, 900.0]])
    axis = drawn(monkeypatch, room, SiteObjects.from_arrays(apart)).axes[0]
    assert 25 < axis.get_xlim()[1] - room.site.origin[0] < 60

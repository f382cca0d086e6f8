"""The map of a campaign and of what a field found: what is on it,
and that it is drawn for every kind.
"""

import numpy as np
import pytest
from matplotlib.figure import Figure

from gsparc.data.site_objects import SiteObjects
from gsparc.data.walls import SceneWalls
from gsparc.pictures import found_plan, site_plan
from gsparc.pictures.found_plan import draw_site_objects
from gsparc.pictures.site_plan import draw_site, find_spots
from gsparc.tables.checks.level_steps import LevelStep, find_level_steps, link_levels
from gsparc.tables.own import from_arrays


def scattered(count=80):
    return np.random.default_rng(0).uniform([0, 0, 1], [30, 12, 2], (count, 3))


@pytest.fixture
def figures(monkeypatch):
    """The figures that were drawn; nothing is written."""
    kept: list[Figure] = []
    for module in (site_plan, found_plan):
        monkeypatch.setattr(module, "save", lambda figure, path: kept.append(figure))
    return kept


def words(figure: Figure) -> str:
    """All text of a figure, a line each."""
    figure.draw_without_rendering()
    return "\n".join(
        text.get_text() for text in figure.findobj(lambda part: hasattr(part, "get_text"))
    )


def shown(data, figures):
    levels = link_levels(data)
    draw_site(data, "unused.png", levels, [] if levels is None else find_level_steps(levels))
    return figures[-1], words(figures[-1])


def test_check_drew_the_mean_of_the_stations_heard():
    """A number that no planner uses; the strongest is drawn."""
    place = scattered(10)
    level = np.stack([np.full(10, -60.0), np.full(10, -80.0), np.full(10, -70.0)], axis=1)
    level[3, 0], level[4, :2] = np.nan, np.nan
    data = from_arrays({"rx_position": place, "station_position": scattered(3), "rssi_db": level})
    found = find_spots(data, link_levels(data))
    assert np.allclose(found.place, place[:, :2])  # world coordinates, in the order of measuring
    expected = np.full(10, -60.0)
    expected[[3, 4]] = -70
    assert np.allclose(found.level_db, expected, atol=1e-4) and not found.suspicious.any()
    assert found.label == "received power of the strongest station [dB]"


def test_of_the_sectors_of_a_mast_the_last_alone_was_named(figures):
    mast = scattered(2)[[0, 0, 1]]
    arrays = {
        "rx_position": scattered(),
        "station_position": mast,
        "rssi_db": np.full((80, 3), -60.0),
    }
    assert (
        "A-1, A-2"
        in shown(from_arrays({**arrays, "station_name": ["A-1", "A-2", "B-1"]}), figures)[1]
    )


def test_levels_in_dbm_were_drawn_as_db(figures):
    place, level = scattered(), np.linspace(-90, -40, 80)
    arrays = {
        "rx_position": place,
        "station_position": np.array([[3.0, 3, 5]]),
        "rssi_db": level[:, None],
    }
    data = from_arrays(arrays, {"level_unit": "dBm"})
    levels = link_levels(data)
    draw_site(data, "unused.png", levels, [(0, LevelStep(39, 40, -25.0))])
    assert {axis.get_ylabel() for axis in figures[-1].axes} >= {
        "level [dBm]",
        "received power [dBm]",
    }


STATION = np.array([101.0, 204.0, 2.0])
HALF = np.sqrt(0.5)
# Two walls, and a floor
PLANES = np.array([[1.0, 0, 0, 5.0], [HALF, HALF, 0, 2.0], [0, 0, 1.0, -1.0]])
BOX = np.array([[[1.0, 1.0, -1.0], [2.0, 3.0, 0.0]]])


@pytest.fixture
def room():
    """Powers of a room far from the origin of its coordinates."""
    places = np.random.default_rng(0).uniform([100, 200, 1], [108, 206, 1.1], (60, 3))
    arrays = {"rx_position": places, "tx_position": STATION, "rssi_db": np.linspace(-60, -40, 60)}
    return from_arrays(arrays, {"name": "room"})


def drawn(figures, data, objects, known=None) -> Figure:
    draw_site_objects(data, objects, "unused.png", known)
    figures[0].draw_without_rendering()
    return figures[0]


def test_walls_and_boxes_are_drawn_where_they_are(room, figures):
    corners = np.array([[100.0, 200, 0], [108, 200, 0], [108, 200, 3], [100, 200, 3]])
    known = SceneWalls((corners,), BOX + room.site.origin)
    figure = drawn(figures, room, SiteObjects.from_arrays(PLANES, BOX), known)
    lines = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    np.testing.assert_allclose(lines["mirror planes found"][:, 0], 5.0 + room.site.origin[0])
    np.testing.assert_allclose(lines["known walls"], [[108, 200], [100, 200]])
    np.testing.assert_allclose(lines["ends that stand"], STATION[None, :2])
    assert {text.get_text() for text in figure.legends[0].get_texts()} == {
        "measured places",
        "known walls",
        "known boxes",
        "mirror planes found",
        "boxes found (1)",
        "ends that stand",
    }
    assert f"z = {room.site.origin[2] - 1.0:.2f} m" in figure.get_suptitle()


def test_a_wall_apart_from_all_places_was_beside_the_map(room, figures):
    apart = np.array([[1.0, 0, 0, 25.0], [1.0, 0, 0, 900.0]])
    axis = drawn(figures, room, SiteObjects.from_arrays(apart)).axes[0]
    assert 25 < axis.get_xlim()[1] - room.site.origin[0] < 60

"""Cells of the floors of a building."""

from __future__ import annotations

import numpy as np

from gsparc.locate.cells import MARGIN_M, cover_floors, floors


def building(count: int = 300) -> np.ndarray:
    """Places on two floors of 40 x 20 m, the upper one only in its west half."""
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 1, (count, 3)) * [40, 20, 0.3]
    upper = rng.random(count) < 0.5
    places[upper] = places[upper] * [0.5, 1, 1] + [0, 0, 4]
    return places


def test_heights_of_one_floor_are_one():
    height = building()[:, 2]
    found = floors(height)
    assert len(np.unique(found)) == 2 and (np.abs(found - height) < 0.3).all()
    assert floors(np.array([3.0])).tolist() == [3.0] and len(np.unique(floors(np.zeros(5)))) == 1


def test_cells_cover_every_floor_once_and_are_finer_near_places():
    places = building()
    cells = cover_floors(places, around=False)
    box = np.ptp(places[:, :2], axis=0) + 2 * MARGIN_M
    assert np.isclose(cells.size.sum(), 2 * box.prod()) and len(cells) <= 8000
    assert not cells.edge[:, 2].any() and len(np.unique(cells.centre[:, 2])) == 2
    east = (cells.centre[:, 0] > 26) & (cells.centre[:, 2] > 2)  # where nobody was
    assert cells.edge[east, 0].min() > cells.edge[~east, 0].min()
    near = cover_floors(places, around=True)
    assert len(near) < len(cells) and near.size.sum() < 0.85 * cells.size.sum()


def test_a_single_place_has_cells_too():
    cells = cover_floors(np.array([[1e6, 2e6, 5.0]]), around=False)
    assert np.isclose(cells.size.sum(), (2 * MARGIN_M) ** 2) and (cells.centre[:, 2] == 5).all()

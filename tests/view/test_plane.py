"""Planes of power: coarse first, exact at the end."""

from __future__ import annotations

import numpy as np

from gsparc.view.plane import lifted, refining, sheet, thinned, weakest
from gsparc.view.scene import Legend


def test_the_last_plane_is_what_the_model_says_of_every_cell(power_view):
    name, grid = power_view.viewed.stations[0], power_view.grid
    asked = power_view.viewed.asked(name)
    planes = [plane for plane in refining(asked, grid) if plane is not None]
    assert [plane.stride for plane in planes] == [2, 1]
    assert all(np.isfinite(plane.level_db).all() for plane in planes)
    direct = 10 * np.log10(asked.rssi(rx=grid.places())).reshape(grid.shape)
    np.testing.assert_allclose(planes[-1].level_db, direct, atol=1e-4)
    np.testing.assert_array_equal(weakest(planes[-1]), grid.places()[direct.argmin()])


def test_a_lifted_plane_is_asked_at_its_height(power_view):
    asked = power_view.viewed.asked(power_view.viewed.stations[0])
    high = lifted(thinned(power_view.grid, 10), 6.0)
    *_, plane = refining(asked, high)
    assert (high.places()[:, 2] == 6.0).all() and max(high.shape) <= 11
    direct = 10 * np.log10(asked.rssi(rx=high.places())).reshape(high.shape)
    np.testing.assert_allclose(plane.level_db, direct, atol=1e-4)


def test_a_sheet_lies_north_up_and_is_clear_where_nothing_is_known(power_view):
    grid = power_view.grid
    values = np.zeros(grid.shape)
    values[0, 0] = np.nan  # south-west
    made = sheet("plane", grid, values, Legend("", 0.0, 1.0))
    assert made.image[-1, 0, 3] == 0 and (made.image[:-1, :, 3] > 0).all()
    left, _, _, high = grid.extent
    np.testing.assert_allclose(made.corner, [left, high, grid.height])
    assert made.right[0] > 0 and made.down[1] < 0

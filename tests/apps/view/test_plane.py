"""Planes of power: coarse first, exact at the end."""

import numpy as np
from campaigns import channels
from towns import trained

from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.answer import predict_answer
from gsparc.apps.view.building import open_model
from gsparc.apps.view.site_view import lay_power_plane, plane_sheet, refine_plane, weakest_place


def test_the_last_plane_is_what_the_model_says_of_every_cell(power_view):
    name, grid = power_view.viewed.stations[0], power_view.grid
    asked = power_view.viewed.predictor_of(name)
    planes = [plane for plane in refine_plane(asked, grid) if plane is not None]
    assert [plane.stride for plane in planes] == [2, 1]
    assert all(np.isfinite(plane.level_db).all() for plane in planes)
    direct = asked.rssi(rx=grid.places()).reshape(grid.inside.shape)
    np.testing.assert_allclose(planes[-1].level_db, direct, atol=1e-4)
    first = weakest_place(planes[-1])
    np.testing.assert_array_equal(first, grid.places()[direct.argmin()])
    second = weakest_place(planes[-1], [first])
    assert np.linalg.norm(second - first) >= 0.1 * max(grid.inside.shape) * grid.step
    assert weakest_place(planes[-1], grid.places()) is None


def test_a_sheet_lies_north_up_and_is_clear_where_nothing_is_known(power_view):
    grid = power_view.grid
    values = np.zeros(grid.inside.shape)
    values[0, 0] = np.nan  # south-west
    dot = power_view.station("west").dot
    assert power_view.station("west").power is not None
    # So that dots are seen whole
    made = plane_sheet("plane", grid, values, Legend("", 0.0, 1.0), dot / 2)
    assert made.image[-1, 0, 3] == 0 and (made.image[:-1, :, 3] > 0).all()
    left, _, _, high = grid.extent
    assert dot > 0
    np.testing.assert_allclose(made.corner, [left, high, grid.height - dot / 2])
    assert made.right[0] > 0 and made.down[1] < 0


def test_a_plane_of_channels_has_the_level_that_answers_have(tmp_path):
    """It was of the mean alone: up to 24 dB below the answer where the mean fades
    and the error does not.
    """
    viewed = open_model(trained(channels(tmp_path / "room.npz", shape="S"), "gp"))
    *_, plane = refine_plane(viewed.predictor_of(None), lay_power_plane(viewed, {"step_m": 0.5}))
    said = [
        predict_answer(viewed.predictor_of(None), {"rx": place}) for place in plane.grid.places()
    ]
    assert any(one.response is not None and one.spread_db > 2 for one in said)
    np.testing.assert_allclose(
        plane.level_db[plane.grid.inside], [one.level_db for one in said], atol=1e-3
    )

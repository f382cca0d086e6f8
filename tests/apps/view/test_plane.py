"""Planes of power: coarse first, exact at the end."""

import numpy as np
from campaigns import channels
from towns import trained

from gsparc.apps.view.answer import predict_answer
from gsparc.apps.view.building import open_model
from gsparc.apps.view.site_view import lay_power_plane, refine_plane, weakest_place


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

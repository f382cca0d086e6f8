"""Drawn units and colours."""

import numpy as np

from gsparc.apps.maps.area import FloorPlan
from gsparc.apps.view.building import build_scene
from gsparc.apps.view.scene import EXTENT, DrawingFrame


def test_a_site_far_from_its_origin_is_drawn_to_the_millimetre():
    places = np.array([[4.5e6, 5.1e5, 0], [4.5e6 + 2000, 5.1e5 + 900, 30]])
    frame = DrawingFrame.around(places)
    drawn = frame.to_drawn(places)
    assert drawn.dtype == np.float32 and np.ptp(drawn, axis=0).max() == EXTENT
    np.testing.assert_allclose(frame.to_world(drawn), places, atol=1e-3)


def test_a_floor_plan_and_the_grid_lie_beneath_the_plane(power_view):
    """The plan lay at the height of the plane: of each other half was hidden."""
    viewed, plan = power_view.viewed, FloorPlan(np.zeros((60, 80, 3), np.uint8), 1 + 0j, 60j)
    low = viewed.heights()[0]
    scene = build_scene(viewed, plan, "west", None)
    assert scene.ground < scene.part("floor plan").corner[2] < low <= power_view.grid.height

"""What is answered at a place, and what is said of why."""

import numpy as np

from gsparc.apps.view.answer import PlaceAnswer, PlacePaths, merge_paths
from gsparc.apps.view.building import BOX, MIRROR
from gsparc.apps.view.reasons import explain_level, legend_html
from gsparc.apps.view.scene import Faces

HERE = np.zeros(3)


def test_a_fade_is_said_to_be_one():
    paths = PlacePaths(np.array([-40.0, -40.5]), np.array([10.0, 20]), None)
    said = " | ".join(
        explain_level(PlaceAnswer({"rx": HERE}, level_db=-60.0, paths=paths), "rx", None)
    )
    assert "they cancel each other: 22.8 dB less than their powers" in said
    said = " | ".join(
        explain_level(PlaceAnswer({"rx": HERE}, level_db=-37.5, paths=paths), "rx", None)
    )
    assert "their powers" not in said


def test_a_path_that_two_searches_found_is_one_path():
    """Their direct paths were two, each 6 dB too weak, that "add up"."""
    one, other = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    gain = np.array([[0.05j, 0.01, 0.05j, 1e-9]])
    found = merge_paths(
        gain, np.array([5.0, 9.0, 5.1, 9.0]), np.array([one, other, [0.9999, 0.01, 0.01], one])
    )
    np.testing.assert_allclose(found.gain_db, [-20, -40])
    np.testing.assert_array_equal(found.delay_ns, [5.0, 9.0])
    assert len(merge_paths(gain, np.array([5.0, 9.0, 5.1, 9.0]), None).gain_db) == 3


def test_what_surfaces_are_is_said_once_of_each_colour():
    """Planes were drawn in a colour that nothing explained."""
    faces = [Faces("a", np.zeros((1, 3, 3)), colour, 0.5) for colour in (MIRROR, BOX, BOX)]
    said = legend_html([], faces)
    assert said.count("boxes that were found") == said.count("mirror planes that were found") == 1

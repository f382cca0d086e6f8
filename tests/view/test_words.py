"""What is said beside a scene."""

from __future__ import annotations

import numpy as np

from gsparc.view.answer import Answer
from gsparc.view.building import MIRROR, WALL
from gsparc.view.reasons import answer_markdown, legend_html
from gsparc.view.scene import Faces


def test_nought_has_no_sign():
    said = answer_markdown(Answer({"rx": np.array([-0.001, 0.0, -1.0])}, 1.0, level_db=-50.0), ["rx"], [])
    assert "receiver at 0.00, 0.00, -1.00 m" in said


def test_what_surfaces_are_is_said_once_of_each_colour():
    """Planes were drawn in a colour that nothing explained."""
    faces = [
        Faces("a", np.zeros((3, 3)), np.zeros((1, 3), int), colour, 0.5) for colour in (MIRROR, WALL, WALL)
    ]
    said = legend_html([], faces)
    assert said.count("known walls") == said.count("mirror planes that were found") == 1

"""What is answered at a place, and what is said of why."""

import re
from dataclasses import replace

import numpy as np
import pytest

from gsparc.apps.view.answer import Answer, Rays, ask, rays
from gsparc.apps.view.building import MIRROR, WALL, rays_of
from gsparc.apps.view.crossed import Obstacles
from gsparc.apps.view.reasons import Surroundings, answer_markdown, headline, legend_html, reasons, usual
from gsparc.apps.view.scene import Faces
from gsparc.data.walls import SceneWalls

HERE = np.zeros(3)
NO_BOXES = np.zeros((0, 2, 3))


def test_the_distance_law_of_measurements_is_found_and_missing_ones_left_out():
    rng = np.random.default_rng(0)
    places = rng.uniform(1, 100, (200, 3))
    level = -30 - 25 * np.log10(np.linalg.norm(places, axis=1))
    level[:20] = np.nan
    law = usual(places, level, np.zeros(3))
    assert (law.at_one, law.slope) == (pytest.approx(-30), pytest.approx(25)) and law.spread_db < 1e-6
    assert np.isnan(usual(places, level, None).at_one)
    apart = usual(places + 7, level, np.full((200, 3), 7.0))  # where the other end moved as well
    assert (apart.at_one, apart.slope) == (pytest.approx(-30), pytest.approx(25))


def test_near_the_other_end_nothing_is_called_weak_that_is_as_strong_as_any():
    """A line through levels behind walls foretold 28 dB too much at 1.4 m, the weakest place of all."""
    distance = np.linspace(2, 50, 200)
    level = -30 - 20 * np.log10(distance) - 40 * (distance > 20)
    law = usual(np.column_stack([distance, 0 * distance, 0 * distance]), level, np.zeros(3))
    assert law.at_one > -10 and law.at(1.0) == pytest.approx(level.max())


def test_a_weak_place_behind_something_is_explained():
    rng = np.random.default_rng(0)
    places = rng.uniform(-20, 20, (200, 3))
    level = -30 - 20 * np.log10(np.linalg.norm(places, axis=1)) + rng.normal(size=200)
    here = np.array([10.0, 0, 0])
    answer = Answer({"rx": here, "tx": -here}, level_db=-75.0)
    about = Surroundings(usual(places, level, np.zeros(3)), level, unit="dBm")
    said = " | ".join(reasons(answer, "rx", about))
    assert "20 m from the other end" in said and "(weaker" in said and "weaker than 100%" in said
    assert "what takes the rest is not known" in said and "nearest measurement" in said
    assert re.search(r"distance alone: -[\d.]+ dBm; here [\d.]+ dB less", said)  # it said dB for both
    walls = Obstacles.of(
        SceneWalls((np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]),), NO_BOXES)
    )
    said = " | ".join(reasons(answer, "rx", replace(about, walls=walls)))
    assert "crosses 1 wall or boxes" not in said and "crosses 1 wall or box" in said
    assert "is not known" not in said


def test_where_both_ends_moved_the_nearest_measurement_is_one_of_both():
    """A receiver that was measured with a transmitter far away was said to be measured here."""
    rx, tx = np.zeros((2, 3)), np.array([[1.0, 0, 0], [9, 0, 0]])
    about = Surroundings(usual(rx, np.zeros(2), tx))
    said = reasons(Answer({"rx": np.zeros(3), "tx": np.array([3.0, 0, 0])}), "rx", about)
    assert said[-1] == "nearest measurement: transmitter 2 m and receiver 0 m away"
    assert reasons(Answer({"rx": np.zeros(3), "tx": tx[1]}), "rx", about)[-1] == "measured here"


def test_a_weak_spectrum_is_said_to_be_one():
    answer = Answer({"rx": HERE}, spectrum=np.full((2, 2), 0.2))
    said = reasons(answer, "rx", Surroundings(values=np.array([0.1, 0.3, 0.4, np.nan])))
    assert said == ["mean of the spectrum 0.200, lower than 67% of what was measured"]


def test_a_fade_is_said_to_be_one():
    paths = Rays(np.array([-40.0, -40.5]), np.array([10.0, 20]), None)
    said = " | ".join(reasons(Answer({"rx": HERE}, level_db=-60.0, paths=paths), "rx", Surroundings()))
    assert "they cancel each other: 22.8 dB less than their powers" in said
    said = " | ".join(reasons(Answer({"rx": HERE}, level_db=-37.5, paths=paths), "rx", Surroundings()))
    assert "their powers" not in said


def test_a_spectrum_and_a_power_are_answered(spectrum_view, power_view):
    spectrum = ask(spectrum_view.viewed.predictor_of(None), spectrum_view.starts(None))
    assert spectrum.spectrum.shape == (16, 32) and spectrum.level_db is None
    assert set(spectrum.ends) == {"tx", "rx"}
    grid = spectrum_view.viewed.site.grid  # it said -29 degrees of the world over a peak at 58
    row, column = np.unravel_index(spectrum.spectrum.argmax(), spectrum.spectrum.shape)
    left, _, low, high = grid.edges()
    peak = left + (column + 0.5) * np.degrees(grid.azimuth_step), low + (row + 0.5) * (high - low) / 16
    assert spectrum.strongest[:2] == pytest.approx(peak, abs=0.01)
    assert "azimuth {:.0f}°, elevation {:.0f}° at the receiver (".format(*spectrum.strongest) in headline(
        spectrum
    )
    name = power_view.viewed.stations[1]
    asked, at = power_view.viewed.predictor_of(name), power_view.starts(name)
    power = ask(asked, at)
    assert power.level_db == pytest.approx(float(asked.rssi(**at)[0]), abs=1e-3)
    assert power.spread_db > 0 and power.spectrum is None


def test_a_path_that_two_searches_found_is_one_path():
    """Their direct paths were two, each 6 dB too weak, that "add up"."""
    one, other = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    gain = np.array([[0.05j, 0.01, 0.05j, 1e-9]])
    found = rays(gain, np.array([5.0, 9.0, 5.1, 9.0]), np.array([one, other, [0.9999, 0.01, 0.01], one]))
    np.testing.assert_allclose(found.gain_db, [-20, -40])
    np.testing.assert_array_equal(found.delay_ns, [5.0, 9.0])
    assert len(rays(gain, np.array([5.0, 9.0, 5.1, 9.0]), None).gain_db) == 3


def test_rays_are_as_long_as_their_delays():
    towards = np.array([[1.0, 0, 0], [0, 1, 0]])
    rays = Rays(np.array([-40.0, -50]), np.array([10.0, 20]), towards)
    lines, ends = rays_of(Answer({"rx": np.ones(3)}, paths=rays), 100.0)
    length = np.linalg.norm(ends.places - 1, axis=1)
    np.testing.assert_allclose(length, [2.998, 5.996], rtol=1e-3)
    assert lines.segments.shape == (2, 2, 3)


def test_nought_has_no_sign():
    said = answer_markdown(Answer({"rx": np.array([-0.001, 0.0, -1.0])}, level_db=-50.0), ["rx"], [])
    assert "receiver at 0.00, 0.00, -1.00 m" in said


def test_what_surfaces_are_is_said_once_of_each_colour():
    """Planes were drawn in a colour that nothing explained."""
    faces = [
        Faces("a", np.zeros((3, 3)), np.zeros((1, 3), int), colour, 0.5) for colour in (MIRROR, WALL, WALL)
    ]
    said = legend_html([], faces)
    assert said.count("known walls") == said.count("mirror planes that were found") == 1

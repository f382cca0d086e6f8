import numpy as np
import pytest

from gsparc.simulate.effects import DIFFUSE, EDGE, REFRACTION, SPECULAR, Effects, from_config
from gsparc.simulate.paths import TracedPaths

EVERYTHING = Effects(depth=3)


def paths_of(mechanisms, order, owner=None, ports=1):
    """Paths of unit gain with given records; all of receiver 0 unless said."""
    count = len(mechanisms)
    owner = np.zeros(count, int) if owner is None else np.array(owner)
    direction = np.tile(np.array([[1.0, 0, 0]], np.float32), (count, 1))
    return TracedPaths(
        np.concatenate([[0], np.cumsum(np.bincount(owner))]),
        np.ones((count, ports), np.complex64),
        np.arange(count) * 1e-9,
        direction,
        np.array(mechanisms, np.uint8),
        np.array(order, np.uint8),
    )


def test_path_needs_all_its_mechanisms_and_depth():
    found = paths_of([0, SPECULAR, SPECULAR | DIFFUSE, REFRACTION, EDGE], [0, 1, 2, 1, 1])

    def left(effects):
        return effects.allows_paths(found.mechanisms, found.order).tolist()

    assert left(EVERYTHING) == [True] * 5
    assert left(EVERYTHING.switch_off("line_of_sight")) == [False, True, True, True, True]
    assert left(EVERYTHING.switch_off("specular")) == [True, False, False, True, True]
    assert left(EVERYTHING.switch_off("diffuse")) == [True, True, False, True, True]
    assert left(EVERYTHING.switch_off("diffraction")) == [True, True, True, True, False]
    assert left(Effects(depth=1)) == [True, True, False, True, True]
    assert left(Effects(depth=0)) == [True, False, False, False, False]


@pytest.mark.parametrize(
    "config, words",
    [
        ({"specular": False}, "diffuse needs"),
        ({"diffraction": False}, "edge_diffraction needs"),
        ({"depth": 9}, "at most 8"),
        ({"speculr": True}, "speculr: no such effect"),
        (
            dict.fromkeys(
                (
                    "line_of_sight",
                    "specular",
                    "refraction",
                    "diffraction",
                    "edge_diffraction",
                    "diffuse",
                ),
                False,
            ),
            "every mechanism is off",
        ),
    ],
)
def test_contradictions_are_refused(config, words):
    with pytest.raises(ValueError, match=words):
        from_config(config)


def test_delay_spread_of_two_equal_paths():
    found = paths_of([0, SPECULAR], [0, 1])
    assert found.delay_spread()[0] == pytest.approx(0.5e-9)
    assert found.select_paths(np.array([True, False])).delay_spread()[0] == 0.0


def test_response_of_one_path():
    found = paths_of([0, SPECULAR], [0, 1]).select_paths(np.array([False, True]))  # 1 ns, from +x
    tones, wavelength = np.array([2.4e9, 2.5e9]), 0.125
    elements = np.array([[0.0, 0, 0], [wavelength / 4, 0, 0]])
    channel = found.responses(tones, elements, wavelength)[0]
    expected = np.exp(-2j * np.pi * tones * 1e-9) * np.array([[1], [1j]])
    np.testing.assert_allclose(channel, expected, atol=1e-6)

"""Places by another measure than the other end's are told by how powers fall with distance."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from gsparc.data.checks.conventions import convention_warnings
from gsparc.data.datasets.own import apply_settings
from gsparc.data.own import from_arrays, interpret
from gsparc.data.raw import Raw

FOOT, ROWS = 0.3048, 300
WRONG = {
    "static_feet": lambda rows, still: (rows, still / FOOT),
    "moving_feet": lambda rows, still: (rows / FOOT, still),
    "heights_feet": lambda rows, still: (rows / [1, 1, FOOT], still),
    "exchange_xy": lambda rows, still: (rows[:, [1, 0, 2]], still),
}


def flight(seed: int) -> dict[str, np.ndarray]:
    """Arrays of a drone over three stations; shadowing of 5 dB over 40 m, noise of 2 dB."""
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(0, [300, 200], (ROWS, 2)), rng.uniform(10, 120, ROWS)]
    still = np.c_[rng.uniform(0, [300, 200], (3, 2)), rng.uniform(5, 30, 3)]
    root = np.linalg.cholesky(25 * np.exp(-cdist(place, place) / 40) + 1e-6 * np.eye(ROWS))
    station = np.arange(ROWS) % 3
    away = np.linalg.norm(place - still[station], axis=1)
    shadow = (root @ rng.normal(size=(ROWS, 3)))[np.arange(ROWS), station]
    level = -30 - 28 * np.log10(away) + shadow + rng.normal(0, 2, ROWS)
    return {"rx_position": place, "station_position": still, "station": station, "rssi_db": level}


@pytest.mark.parametrize("name", list(WRONG))
def test_places_of_another_measure_are_named_and_the_setting_mends_them(name):
    found = 0
    for seed in range(4):
        right = flight(seed)
        rows, still = WRONG[name](right["rx_position"], right["station_position"])
        raw = Raw({**right, "rx_position": rows, "station_position": still})
        said = convention_warnings(interpret(raw, "file").data)
        found += len(said) == 1 and f"dataset.{name}=true" in said[0]
        mended = interpret(apply_settings(raw, **{name: True}), "file").data
        assert not convention_warnings(mended)
        np.testing.assert_allclose(mended.moving + mended.site.origin, right["rx_position"][:, :3], atol=1e-9)
    assert found >= 3


def test_right_places_are_not_doubted():
    for seed in range(20, 32):
        assert not convention_warnings(from_arrays(flight(seed)))
    # Levels that say nothing of places.
    rng, right = np.random.default_rng(0), flight(40)
    assert not convention_warnings(from_arrays({**right, "rssi_db": rng.normal(-80, 8, ROWS)}))

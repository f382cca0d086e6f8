"""Places by another measure than the other end's are told by how powers fall with distance."""

import numpy as np
import pytest
from level_fields import ROWS, flight

from gsparc.datasets.own import apply_settings
from gsparc.tables.checks.conventions import convention_warnings
from gsparc.tables.own import from_arrays, interpret
from gsparc.tables.raw import Raw

FOOT = 0.3048
WRONG = {
    "static_feet": lambda rows, still: (rows, still / FOOT),
    "moving_feet": lambda rows, still: (rows / FOOT, still),
    "static_kilometres": lambda rows, still: (rows, still / [1e3, 1e3, 1]),
    "moving_kilometres": lambda rows, still: (rows / [1e3, 1e3, 1], still),
    "heights_feet": lambda rows, still: (rows / [1, 1, FOOT], still),
    "exchange_xy": lambda rows, still: (rows[:, [1, 0, 2]], still),
}


@pytest.mark.slow
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
        np.testing.assert_allclose(
            mended.moving + mended.site.origin, right["rx_position"][:, :3], atol=1e-9
        )
    assert found >= 3


@pytest.mark.slow
def test_right_places_are_not_doubted():
    for seed in range(20, 32):
        assert not convention_warnings(from_arrays(flight(seed)))
    # Levels that say nothing of places.
    rng, right = np.random.default_rng(0), flight(40)
    assert not convention_warnings(from_arrays({**right, "rssi_db": rng.normal(-80, 8, ROWS)}))

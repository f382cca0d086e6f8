"""What errors of places and cells have in common where nobody walked."""

from dataclasses import replace

import numpy as np
import pytest

from gsparc.apps.maps.intervals import calibrate
from gsparc.apps.maps.joint_errors import RegionErrors
from gsparc.apps.maps.promise import Promise, number_quarters
from gsparc.prediction.left_out import HeldOutLevels

ROWS, QUARTERS, CELLS = 4000, 8, 3


def promise(all_db: float, each_db: float, own_db: float, seed: int = 0) -> Promise:
    """Quarters, 10 to 300 m from rows, whose errors have a part of all, of each cell, of each row;
    blocks up to 20 m from rows have 4 dB.
    """
    rng = np.random.default_rng(seed)
    far, cell = rng.uniform(10, 300, ROWS), rng.integers(CELLS, size=ROWS)
    quarter = np.arange(ROWS) % QUARTERS
    error = all_db * rng.permutation([-1, 1] * (QUARTERS // 2))[quarter]
    shared = np.resize([-1.0, 1.0, 1.0, -1.0], (QUARTERS, CELLS))
    error = error + each_db * shared[quarter, cell] + own_db * rng.normal(size=ROWS)
    ones, none = np.ones(ROWS), np.zeros(ROWS, np.int8)
    out = HeldOutLevels(error, 0 * ones, 4 * ones, far, quarter, cell, none)
    near = 4 * rng.normal(size=ROWS)
    blocks = HeldOutLevels(near, 0 * ones, 4 * ones, far / 15, np.arange(ROWS) // 20, cell, none)
    places = np.column_stack([rng.uniform(0, 600, (ROWS, 2)), ones])
    return Promise(blocks, places, cell, 20.0, out)


@pytest.mark.parametrize(
    ("parts", "expected"), [((6, 0, 6), (0.5, 0)), ((0, 6, 6), (0, 0.5)), ((0, 0, 8), (0, 0))]
)
def test_a_share_took_errors_of_cells_for_independent_where_nobody_walked(parts, expected):
    """Terrain, phone and gain are shared: 48.5 % of a quarter were covered, 79.1 % said."""
    region = RegionErrors.from_promise(promise(*parts))
    assert region.quarters == QUARTERS
    # Half of what is shared counts a block from rows: a little more is shared farther off.
    assert (region.all, region.each) == pytest.approx(expected, abs=0.12)


def test_near_rows_errors_are_the_models_own_and_far_ones_a_regions():
    region = RegionErrors(0.4, 0.3, near_m=20.0, length_m=300.0, quarters=8)
    places = np.array([[0.0, 0, 0], [400, 0, 0], [0, 50, 0]])
    alike, cells = np.eye(3), np.array([0, 1, 0])
    near = region.correlations(alike, places, cells, np.zeros(3))
    far = region.correlations(alike, places, cells, np.full(3, 1e6))
    assert near == pytest.approx(np.eye(3)) and far.diagonal() == pytest.approx(1.0)
    assert far[0, 2] > 0.68 and 0.1 < far[0, 1] < 0.2
    assert np.linalg.eigvalsh(far).min() > 0


def test_places_that_blocks_are_not_as_far_from_rows_as_were_refused():
    known = promise(6, 0, 6)
    near, far = calibrate(known.evidence), known.calibration()
    assert near.reach < 21 and far.reach > 250
    spread, cell = np.full(3, 4.0), np.zeros(3, int)
    at = np.array([5.0, 15.0, 200.0])
    (half, error), (_, before) = (c.half_and_error(spread, at, cell) for c in (far, near))
    assert error[:2] == pytest.approx(before[:2], rel=0.02) and np.isnan(before[2])
    assert error[2] == pytest.approx(np.hypot(6, 6), rel=0.15) and half[2] > 1.6 * error[2]
    few = replace(known.quarters, distance=known.quarters.distance / 100)
    assert calibrate(known.evidence, 0.9, few).reach == near.reach


def test_quarters_have_as_many_places_each_way_round():
    places = np.random.default_rng(0).gamma(1.0, 100.0, (400, 3))
    for turned in (False, True):
        assert np.bincount(number_quarters(places, turned)).tolist() == [100] * 4

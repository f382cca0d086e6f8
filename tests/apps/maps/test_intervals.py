"""Intervals hold what they promise on blocks they never saw, widen with distance, and end."""

from dataclasses import replace

import numpy as np
import pytest

from gsparc.apps.maps.intervals import LEAST_ROWS, calibrate, cross_validate
from gsparc.prediction.left_out import HeldOutLevels
from gsparc.processes.uncertainty import coverage_and_width


def held(scales, rows):
    """Share of rows in their intervals, of those in reach."""
    return coverage_and_width(rows.level_db - rows.mean_db, scales.half_of(rows))[0]


def evidence(count=3000, seed=0, heavy=False, stations=1):
    """Errors grow with distance twice as fast as the model says; blocks of 30 rows err alike."""
    rng = np.random.default_rng(seed)
    block = np.arange(count) // 30
    distance = rng.uniform(0, 10, count)
    spread = 2 + 0.1 * distance
    shared = rng.normal(size=block.max() + 1)[block]
    draw = rng.standard_t(4, count) / np.sqrt(2) if heavy else rng.normal(size=count)
    station = rng.integers(0, stations, count)
    error = (2 + 0.2 * distance) * (0.6 * shared + 0.8 * draw) * (1 + station)
    return HeldOutLevels(
        -70 + error, np.full(count, -70.0), spread, distance, block, station, np.zeros(count, bool)
    )


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("share", [0.5, 0.8, 0.9])
def test_as_many_lie_inside_as_promised(heavy, share):
    learned, fresh = evidence(heavy=heavy), evidence(seed=1, heavy=heavy)
    assert abs(held(calibrate(learned, share), fresh) - share) < 0.03
    assert abs(cross_validate(learned, share).share - share) < 0.03


def test_width_rises_with_distance_and_ends():
    found = calibrate(evidence())
    far = np.linspace(0, found.reach, 50)
    half, _ = found.half_and_error(np.full(50, 2.0), far, np.zeros(50, int))
    assert np.isfinite(half).all() and half[-1] > 1.2 * half[0]
    assert np.isnan(found.half_and_error(np.array([2.0]), np.array([11.0]), np.array([0]))).all()


def test_the_model_without_any_sense_of_distance_still_gets_wider():
    known = evidence()
    flat = HeldOutLevels(**{**vars(known), "spread_db": np.ones(len(known))})
    half = calibrate(flat).half
    assert (np.diff(half) >= -1e-12).all() and half[-1] > 1.3 * half[0]


def test_each_station_holds_its_own_share():
    known, fresh = evidence(stations=3), evidence(seed=1, stations=3)
    shares = [held(calibrate(known), fresh.subset(fresh.station == t)) for t in range(3)]
    assert max(shares) - min(shares) < 0.08
    assert calibrate(known).station[2] > 1.5 * calibrate(known).station[0]


def test_outage_follows_the_errors_and_not_a_bell():
    known = evidence(heavy=True)
    found = calibrate(known)
    _, expected = found.half_and_error(known.spread_db, known.distance, known.station)
    for below in (-75.0, -71.0, -65.0):
        said = np.nanmean(found.probability_below(below, known.mean_db, expected))
        assert abs(said - np.mean(known.level_db < below)) < 0.03


@pytest.mark.parametrize("side", [1, -1])
def test_silent_rows_are_as_wide_as_what_they_hide(side):
    """Of unlisted cells only those on the wrong side of their level counted:
    intervals held .97 of them.
    """
    known, fresh = evidence(), evidence(seed=1)
    bound = known.mean_db + np.random.default_rng(2).normal(0, 3, len(known))
    hidden = side * (bound - known.level_db) > 0
    parts = {
        "level_db": np.where(hidden, bound, known.level_db),
        "side": (side * hidden).astype(np.int8),
    }
    censored = HeldOutLevels(**{**vars(known), **parts})
    found, whole = calibrate(censored), calibrate(known)
    assert found.tail is None and found.half.mean() == pytest.approx(whole.half.mean(), rel=0.1)
    assert abs(held(found, fresh) - 0.9) < 0.03
    said = cross_validate(censored, 0.9)
    assert abs(said.share - 0.9) < 0.04 and said.rows <= (censored.side == 0).sum()


def test_one_station_without_a_deviation_made_all_errors_thousands_of_decibels():
    """Of two heard rows a process was sure: expected error 8,430 dB, 100 % of the area covered."""
    known = evidence()
    spread = known.spread_db.copy()
    spread[:20] = 1e-6
    found, whole = calibrate(replace(known, spread_db=spread)), calibrate(known)
    assert found.rms.max() < 3 * whole.rms.max()


def test_too_little_evidence_promises_nothing():
    with pytest.raises(ValueError, match="too few rows to test intervals"):
        calibrate(evidence(LEAST_ROWS - 1))

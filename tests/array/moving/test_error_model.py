"""Errors told beforehand: on invented places where the truth about them is known."""

import numpy as np
import pytest

from gsparc.array.moving.error_model import Doubt, Looks, learn_doubt


def looks(count, seed=0):
    rng = np.random.default_rng(seed)
    return Looks(*(rng.uniform(0.5, 1.5, count) for _ in range(4)))


@pytest.fixture(scope="module")
def half_bad():
    """One half of a floor errs ten times as much as the other."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(0, 10, 400), rng.uniform(0, 8, 400), np.full(400, 1.3)])
    truth = np.where(places[:, 0] > 5, 0.3, 0.03)
    return learn_doubt(places, truth * rng.lognormal(-0.125, 0.5, 400), looks(400))


def test_it_knows_the_bad_half_and_the_size_of_the_error(half_bad):
    here = np.column_stack([np.linspace(1, 9, 9), np.full(9, 4.0), np.full(9, 1.3)])
    said = half_bad.relative_error(here, looks(9, 1))
    assert said[:4].max() < 0.06 and said[5:].min() > 0.18
    assert said[:4].mean() == pytest.approx(0.03, rel=0.4) and said[5:].mean() == pytest.approx(0.3, rel=0.4)


def test_a_look_that_goes_with_errors_is_used():
    rng = np.random.default_rng(1)
    places, seen = rng.uniform(0, 10, (300, 3)), looks(300)
    doubt = learn_doubt(places, 0.1 * seen.added**2, seen)
    said = doubt.relative_error(rng.uniform(2, 8, (100, 3)), looks(100, 2))
    assert np.corrcoef(np.log(said), np.log(looks(100, 2).added))[0, 1] > 0.95


def test_far_away_it_doubts_more_and_stays_finite(half_bad):
    away = np.array([[10.0, 4, 1.3], [13.0, 4, 1.3], [1e4, 4, 1.3]])
    near, far, lost = half_bad.relative_error(away, looks(3))
    assert near < far < lost and np.isfinite(lost)


def test_a_column_that_never_changed_is_not_extrapolated():
    """Rows far apart all had the same variance; a query between them once got an error of nothing."""
    rng = np.random.default_rng(2)
    places, seen = rng.uniform(0, 10, (50, 3)), looks(50)
    constant = Looks(np.ones(50), seen.mean, seen.peak, seen.added)
    doubt = learn_doubt(places, rng.lognormal(-2, 0.3, 50), constant)
    other = Looks(np.full(50, 0.2), seen.mean, seen.peak, seen.added)
    np.testing.assert_allclose(doubt.relative_error(places, other), doubt.relative_error(places, constant))


def test_few_rows_and_a_stored_one_say_the_same():
    places = np.eye(3)
    doubt = learn_doubt(places, np.array([0.1, 0.2, 0.3]), looks(3))
    again = Doubt.from_state(doubt.state())
    one, two = (d.relative_error(places + 0.1, looks(3)) for d in (doubt, again))
    np.testing.assert_array_equal(one, two)
    assert (one > 0).all() and np.isfinite(one).all()

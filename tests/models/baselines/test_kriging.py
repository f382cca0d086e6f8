"""Of many places each query is kriged from its nearest alone, and that is nearly what all of them say."""

import warnings

import numpy as np

from gsparc.models.baselines import kriging
from gsparc.models.baselines.kriging import Kriging, Variogram


def field(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, powers [dB] of a smooth field with noise, and queries among them."""
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.uniform(0, 30, (count, 2)), np.ones((count, 1))], 1)
    level = 6 * np.sin(places[:, 0] / 3) + 4 * np.cos(places[:, 1] / 4)
    return places, (level + rng.normal(0, 0.5, count)).astype(np.float32)[:, None], places[:40] + 0.1


def krige(places: np.ndarray, decibels: np.ndarray, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    method = Kriging()
    method.positions, method.values, method.channels = places, decibels, None
    method.variogram = Variogram(0.25, 25.0, 5.0)
    method._factor_system()
    place, weights, variance = method._weights(queries)
    return (weights * decibels[place, 0]).sum(1), variance


def test_nearest_places_screen_the_others(monkeypatch):
    places, decibels, queries = field(600)
    whole, spread = krige(places, decibels, queries)
    monkeypatch.setattr(kriging, "WHOLE", 100)
    near, wider = krige(places, decibels, queries)
    assert np.abs(near - whole).max() < 0.15 and np.sqrt(np.mean((near - whole) ** 2)) < 0.05
    assert (wider >= spread - 1e-9).all() and np.abs(wider / spread - 1).max() < 0.05


def test_two_places_have_no_variogram():
    """Their one distance is more than half the extent: no quantile of nothing could be taken."""
    found = kriging.fit_variogram(np.array([[0.0, 0, 0], [3.0, 4, 0]]), np.array([[-60.0], [-70.0]]))
    assert (found.nugget, found.range) == (0.0, 2.5) and found.sill > 0


def test_few_places_printed_a_warning_of_a_library():
    """`OptimizeWarning: Covariance of the parameters could not be estimated`, which nobody had asked for."""
    rng = np.random.default_rng(0)
    places, levels = np.c_[rng.uniform(0, 50, (4, 2)), np.zeros(4)], np.round(2 * rng.normal(size=(4, 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kriging.fit_variogram(places, levels).sill >= 0

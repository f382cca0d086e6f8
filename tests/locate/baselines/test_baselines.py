"""Each baseline places features, states a distribution where it has one, and refuses what teaches nothing."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from releases import real

from gsparc.locate.baselines import neighbours, network, probabilistic, process
from gsparc.locate.baselines.interface import least_error
from gsparc.locate.fingerprints.rows import parted, read_fingerprints

FITS = {
    "nearest": partial(neighbours.fit, counts=(1,)),
    "knn": partial(neighbours.fit, weighted=False),
    "weighted knn": neighbours.fit,
    "probabilistic": probabilistic.fit,
    "process": process.fit,
    "network": partial(network.fit, budget_s=3.0),
}


def hall(count, seed):
    """Eight smooth features of a hall of 10 x 8 m, the smallest ones silent."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 1, (count, 2)) * [10, 8]
    apart = np.linalg.norm(places[:, None] - np.random.default_rng(5).uniform(0, 1, (8, 2)) * [10, 8], axis=2)
    features = -40 - 5 * apart + rng.normal(0, 1, apart.shape)
    return np.where(features > -75, features, np.nan), places


@pytest.mark.parametrize("name", FITS)
def test_a_hall_is_learned(name):
    locator, (features, places) = FITS[name](*hall(300, 0)), hall(100, 1)
    found = locator.locate(features)
    assert found.place.shape == (100, 2) and found.place.dtype == np.float64
    assert np.median(np.linalg.norm(found.place - places, axis=1)) < 1.2
    if found.log_probability is not None:
        np.testing.assert_allclose(np.exp(found.log_probability).sum(1), 1, rtol=1e-6)
        np.testing.assert_allclose(np.exp(found.log_probability) @ found.grid, found.place, atol=1e-6)
    np.testing.assert_allclose(locator.locate(features[:3]).place, found.place[:3], atol=1e-4)


@pytest.mark.parametrize("name", FITS)
def test_few_rows_and_none(name):
    features, places = hall(40, 0)
    assert np.isfinite(FITS[name](features[:2], places[:2]).locate(features).place).all()
    for bad in (np.full((4, 3), np.nan), np.zeros((3, 3)), np.zeros(4)):
        with pytest.raises(ValueError, match="and a value that is finite"):
            FITS[name](bad, places[:4])


def test_silence_says_where():
    """Two rooms that differ only in what is silent."""
    features = np.array([[-50, np.nan], [-50, -60.0]] * 4)
    places = np.array([[0.0, 0], [9.0, 0]] * 4)
    for fit in (FITS["nearest"], partial(probabilistic.fit, widths=(0.02,))):
        found = fit(features, places).locate(features[:2]).place
        np.testing.assert_allclose(found, places[:2], atol=1e-3)


def test_a_setting_is_chosen_at_places_left_out():
    """Rows of one place are copies: the nearest row is right only where the place itself was learned."""
    features, places = (np.repeat(part, 4, 0) for part in hall(60, 0))
    assert neighbours.fit(features, places).count > 1
    assert least_error((7,), neighbours.fit, features, places) == 7


def test_weighted_neighbours_do_as_published_on_a_floor():
    """1.5 m is known of five neighbours; with silence close to what is heard it is less."""
    rows = read_fingerprints(real("locate/wifine-floor4.npz"))
    train, test = parted(rows, "walks", share=0.25)
    found = neighbours.fit(rows.level[train].astype(float), rows.position[train], counts=(5,))
    apart = np.linalg.norm(found.locate(rows.level[test]).place - rows.position[test], axis=1)
    assert 0.9 < np.median(apart) < 1.6

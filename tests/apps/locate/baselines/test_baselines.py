"""Each baseline places features, and refuses what teaches nothing."""

from functools import partial

import numpy as np
import pytest
from releases import real

from gsparc.apps.locate.baselines.methods import kernel, least_error, neighbours
from gsparc.apps.locate.baselines.network import network
from gsparc.apps.locate.baselines.table import BASELINES
from gsparc.data.datasets.fingerprints import parted, read_fingerprints

FITS = BASELINES | {"mlp": partial(network, budget_s=3.0)}


def hall(count, seed):
    """Eight smooth features of a hall of 10 x 8 m, the smallest ones silent."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 1, (count, 2)) * [10, 8]
    apart = np.linalg.norm(places[:, None] - np.random.default_rng(5).uniform(0, 1, (8, 2)) * [10, 8], axis=2)
    features = -40 - 5 * apart + rng.normal(0, 1, apart.shape)
    return np.where(features > -75, features, np.nan), places


@pytest.mark.parametrize("name", FITS)
def test_hall_is_learned(name):
    locate, (features, places) = FITS[name](*hall(300, 0)), hall(100, 1)
    found = locate(features)
    assert found.shape == (100, 2) and found.dtype == np.float64
    assert np.median(np.linalg.norm(found - places, axis=1)) < 1.2
    np.testing.assert_allclose(locate(features[:3]), found[:3], atol=1e-4)


@pytest.mark.parametrize("name", FITS)
def test_two_rows_suffice_and_bad_rows_are_refused(name):
    features, places = hall(40, 0)
    assert np.isfinite(FITS[name](features[:2], places[:2])(features)).all()
    for bad in (np.full((4, 3), np.nan), np.zeros((3, 3)), np.zeros(4)):
        with pytest.raises(ValueError, match="and a value that is finite"):
            FITS[name](bad, places[:4])


@pytest.mark.parametrize("fit", [FITS["nearest"], partial(kernel, widths=(0.02,))])
def test_silence_tells_rooms_apart(fit):
    features = np.array([[-50, np.nan], [-50, -60.0]] * 4)
    places = np.array([[0.0, 0], [9.0, 0]] * 4)
    np.testing.assert_allclose(fit(features, places)(features[:2]), places[:2], atol=1e-3)


def test_setting_is_chosen_at_places_left_out():
    """Rows of one place are copies: the nearest row is right only where the place itself was learned."""
    features, places = (np.repeat(part, 4, 0) for part in hall(60, 0))
    copies = neighbours(features, places)(features)
    assert np.median(np.linalg.norm(copies - places, axis=1)) < 1e-9  # inverse distances: its own row
    uniform = neighbours(features, places, weights="uniform")(features)
    assert np.median(np.linalg.norm(uniform - places, axis=1)) > 0.01  # of more than one neighbour
    assert least_error((7,), neighbours, features, places) == 7


def test_weighted_neighbours_do_as_published_on_a_floor():
    """1.5 m is known of five neighbours; with silence close to what is heard it is less."""
    rows = read_fingerprints(real("locate/wifine-floor4.npz"))
    train, test = parted(rows, "walks", share=0.25)
    locate = neighbours(rows.level[train].astype(float), rows.position[train], counts=(5,))
    apart = np.linalg.norm(locate(rows.level[test]) - rows.position[test], axis=1)
    assert 0.9 < np.median(apart) < 1.6

"""Fingerprints located: places, floors, areas, tracks; how far it is trusted."""

from dataclasses import replace

import numpy as np
import pytest
from access_points import invented, rows_of, walks

from gsparc.apps.locate.fingerprints.locator import FingerprintLocator, as_snapshots, place, trusted
from gsparc.apps.locate.posterior import Posterior
from gsparc.data.datasets.fingerprints import Fingerprints


def errors(found, rows: Fingerprints) -> np.ndarray:
    return np.linalg.norm(np.array([one.place for one in found]) - rows.position, axis=1)


def test_places_floors_and_areas():
    known, heard = rows_of(*invented(300, floors=2)), rows_of(*invented(60, floors=2, seed=1))
    first = FingerprintLocator.of(known, 0.0, around=False, track=False)
    found, count = trusted(first, known, "random", 1.0, 0.1, 2, 0.9, seed=0)
    located = found.locate(heard)
    error = errors(located, heard)
    assert count == 60 and np.median(error) < 1.2
    floor = np.array([abs(one.place[2] - z) for one, z in zip(located, heard.position[:, 2], strict=True)])
    assert (floor < 1).mean() > 0.95
    inside = [
        one.posterior.level(at) <= found.area.level for one, at in zip(located, heard.position, strict=True)
    ]
    assert 0.8 < np.mean(inside) < 0.98
    assert np.median([one.area for one in located]) < 60  # of 1,200 m2
    assert all(one.modes >= 1 and one.seconds > 0 for one in located)


def test_walks_are_placed_better_together():
    heard = walks(4, 1)
    alone = FingerprintLocator.of(rows_of(*invented(300)), 0.0, around=False, track=False)
    together = replace(alone, speed=1.0)
    assert errors(together.locate(heard), heard).mean() < 0.75 * errors(alone.locate(heard), heard).mean()
    assert 0.05 < FingerprintLocator.of(heard, 0.0, around=False, track=True).speed < 1


def test_place_is_on_one_floor():
    locator = FingerprintLocator.of(rows_of(*invented(60, floors=2)), 0.0, around=True, track=False)
    cells = locator.cells
    low = cells.centre[:, 2] < 2
    mass = np.where(low, 0.6 / low.sum(), 0.4 / (~low).sum())
    assert place(Posterior(cells, np.log(mass / cells.size)))[2] == pytest.approx(cells.centre[low, 2][0])


def test_large_coordinates_change_nothing():
    """UJIIndoorLoc has northings of 4,864,900 m."""
    known, heard = rows_of(*invented(150)), rows_of(*invented(20, seed=1))
    far = np.array([-7500.0, 4_864_900.0, 0])
    near_by, abroad = (
        FingerprintLocator.of(replace(known, position=known.position + shift), 0.0, False, False)
        for shift in (np.zeros(3), far)
    )
    np.testing.assert_allclose(
        errors(near_by.locate(heard), heard),
        errors(abroad.locate(heard), replace(heard, position=heard.position + far)),
        atol=0.1,
    )


def test_plain_methods_get_the_same_rows():
    rows = rows_of(*invented(5))
    made = as_snapshots(rows)
    np.testing.assert_array_equal(made.values.numpy(), rows.level.astype(float))
    np.testing.assert_array_equal(made.place, rows.position)

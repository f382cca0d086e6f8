"""Cells, masses, areas and modes."""

import numpy as np
import pytest
from refusals import refused

from gsparc.apps.locate.posterior import PlacePosterior, cover_box, densest_cells

PLACES = np.random.default_rng(0).uniform(0, 1, (200, 3)) * [4.0, 2.0, 0.0] + [0, 0, 1.5]


def gaussians(cells, middles, width=0.2):
    apart = np.linalg.norm(cells.centre[:, None, :2] - np.asarray(middles, float), axis=2)
    density = np.log(np.exp(-0.5 * (apart / width) ** 2).sum(1) + 1e-30)
    return PlacePosterior(cells, density - np.log((np.exp(density) * cells.volume).sum()))


def test_cells_near_trained_places():
    walked = PLACES[PLACES[:, 0] < 1.0]
    both = np.concatenate([walked, [[4.0, 2.0, 1.5]]])
    around = cover_box(both, 400, True)
    assert len(around) < 0.5 * len(cover_box(both, 400, False))
    refused("single place", cover_box, np.ones((5, 3)), 100, False)


def test_cells_where_a_plan_is_open():
    left = cover_box(PLACES, 400, False, lambda places: places[:, 0] < 2.0)
    assert (left.centre[:, 0] < 2.0).all() and 150 < len(left) < 300
    refused(
        "no open floor", cover_box, PLACES, 400, False, lambda places: np.zeros(len(places), bool)
    )


def test_peak_is_between_middles_of_cells():
    cells = cover_box(PLACES, 400, False)
    truth = np.array([2.037, 1.021])
    found = PlacePosterior(cells, gaussians(cells, [truth], 0.3).sharp, 0.15)
    cell = cells.centre[found.log_density.argmax()]
    assert np.linalg.norm(found.peak()[:2] - truth) < 0.3 * np.linalg.norm(cell[:2] - truth)
    assert found.peak()[2] == 1.5


def test_area_of_a_known_density_holds_its_share():
    found = gaussians(cover_box(PLACES, 20_000, False), [[2.0, 1.0]])
    area = found.cells.volume[densest_cells(found.log_density, found.cells.volume, 0.9)].sum()
    assert area == pytest.approx(-2 * np.pi * 0.2**2 * np.log(0.1), rel=0.02)
    assert found.mass_above(np.array([2.0, 1.0, 1.5])) < 0.01
    assert found.mass_above(np.array([3.9, 1.9, 1.5])) > 0.99


def test_two_places_alike_are_two_modes():
    cells = cover_box(PLACES, 5_000, False)
    assert gaussians(cells, [[0.8, 1.0], [3.2, 1.0]], 0.1).count_modes(0.9) == 2
    assert gaussians(cells, [[0.8, 1.0]], 0.1).count_modes(0.9) == 1

"""Levels of several places and stations with the covariance of their errors."""

from pathlib import Path

import numpy as np
import pytest

import gsparc

STORED = Path(__file__).parents[1] / "oracle" / "stored"
PLACES = np.array([[5.0, 6.0, 1.5], [6.0, 6.0, 1.5], [30.0, 20.0, 1.5]])


def test_stations_at_a_place_and_places_of_a_station_have_one_variance():
    predictor = gsparc.load(STORED / "stations-together.ckpt")
    numbers = list(range(len(predictor.site.stations.name)))
    level, covariance, noise = predictor.joint(PLACES, numbers)
    np.testing.assert_allclose(level, predictor.rssi(tx=PLACES), rtol=1e-5)
    for number, name in enumerate(predictor.site.stations.name):
        own, scatter = predictor.at(name).covariance(tx=PLACES)
        assert scatter == pytest.approx(noise[number])
        np.testing.assert_allclose(own.diagonal() + scatter, covariance[:, number, number], rtol=1e-6)
        assert own[0, 1] > own[0, 2], "errors of neighbours are alike"
    pairs = np.repeat(PLACES[:, None], len(numbers), 1)
    np.testing.assert_array_equal(predictor.joint(pairs, numbers)[1], covariance)


def test_who_knows_no_covariance_says_so():
    assert gsparc.load(STORED / "kriging.ckpt").covariance(rx=PLACES) is None
    assert gsparc.load(STORED / "stations-each.ckpt").joint(PLACES, [0]) is None

"""Levels of several places and stations with the covariance of their errors."""

from pathlib import Path

import numpy as np
import pytest
from towns import town_file

import gsparc
from gsparc.data.own import load_own
from gsparc.data.splits import Fold
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.prediction.predictor import Predictor
from gsparc.training.context import FitContext

STORED = Path(__file__).parents[1] / "oracle" / "stored"
PLACES = np.array([[5.0, 6.0, 1.5], [6.0, 6.0, 1.5], [30.0, 20.0, 1.5]])


def test_stations_at_a_place_and_places_of_a_station_have_one_variance():
    predictor = gsparc.load(STORED / "stations-together.ckpt")
    numbers = list(range(len(predictor.site.stations.name)))
    level, covariance, noise = predictor.predict_joint(PLACES, numbers)
    np.testing.assert_allclose(level, predictor.rssi(tx=PLACES), rtol=1e-5)
    for number, name in enumerate(predictor.site.stations.name):
        own, scatter = predictor.select_station(name).covariance(tx=PLACES)
        assert scatter == pytest.approx(noise[number])
        np.testing.assert_allclose(own.diagonal() + scatter, covariance[:, number, number], rtol=1e-6)
        assert own[0, 1] > own[0, 2], "errors of neighbours are alike"
    pairs = np.repeat(PLACES[:, None], len(numbers), 1)
    np.testing.assert_array_equal(predictor.predict_joint(pairs, numbers)[1], covariance)


def test_who_knows_no_covariance_says_so():
    with pytest.raises(ValueError, match="states none of errors"):
        gsparc.load(STORED / "kriging.ckpt").covariance(rx=PLACES)
    assert gsparc.load(STORED / "stations-each.ckpt").predict_joint(PLACES, [0]) is None


def test_a_plan_of_stations_learned_together_was_an_error_of_shapes(tmp_path):
    """`gsparc plan` of `model=gp stations=together` ended in "size of tensor a (3) must match b (0)"."""
    data = load_own(town_file(tmp_path / "town.npz"))
    method, rows = wrap_per_station(method_class("gp")(), data), np.arange(0, len(data), 7)
    method.fit(data, Fold(rows, rows[:0], rows[:1]), FitContext(tmp_path, stations="together"))
    one = Predictor(method, data.site).select_station(data.site.stations.name[0])
    covariance, noise = one.covariance(**{data.site.moving_end: PLACES})
    assert covariance.shape == (3, 3) and covariance[0, 1] > covariance[0, 2] and noise > 0

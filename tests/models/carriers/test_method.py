"""Spectra of one array at several carriers: paths that all share,
what carriers tell of each other.
"""

from dataclasses import replace
from pathlib import Path

import kinds
import numpy as np
import pytest
import torch
from kinds import CARRIERS, CEILING, ELEMENTS, WALL
from refusals import refused

from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.carriers.alone import CarriersAlone
from gsparc.models.carriers.array import carriers_obstacle
from gsparc.models.carriers.geometry import STEP, directions_and_distances, find_paths
from gsparc.models.carriers.method import CarrierField
from gsparc.models.carriers.plain import DirectBeam, OtherCarriers
from gsparc.models.gsparc import Gsparc
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.ops import Pose, SphereGrid
from gsparc.physics.lags import SpectrumLags
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


@pytest.fixture(scope="module")
def room():
    return kinds.carriers()


def fit(one, data, test):
    train = np.setdiff1d(np.arange(len(data)), test)
    none = train[:0]
    one.fit(data, Fold(train, none, test), FitContext(Path()))
    return one


def error(method, data, rows):
    batch = data.batch(rows)
    return float((method.predict(batch).mean - batch.target).square().mean())


LAST = np.arange(24 * CARRIERS, 30 * CARRIERS)  # rows of six places


@pytest.fixture(scope="module")
def fitted(room):
    return fit(CarrierField(), room, LAST)


def test_rows_left_out_were_in_the_mean_that_told_them():
    """Of eight places each carrier alone seemed 1 dB better than it was: it had all the weight."""
    rng = np.random.default_rng(0)
    places, values = (
        torch.from_numpy(rng.uniform(0, 3, (9, 3))),
        torch.from_numpy(rng.normal(2, 1, (9, 4))),
    )
    carrier = torch.zeros(9, dtype=torch.long)
    alone = CarriersAlone.learn(places, values, carrier, 1, 4)
    for row, missed in enumerate(alone.left_out(carrier)):
        rest = np.delete(np.arange(9), row)
        others = alone.condition(places[rest], values[rest], carrier[rest])
        answer = others.answer(places[row : row + 1], carrier[:1]).mean[0]
        torch.testing.assert_close(missed, values[row] - answer)


@pytest.mark.parametrize("turn", [0, 30])
def test_mirrors_were_found_beyond_their_places_where_beams_overlap(turn):
    """Of beams without cross terms they are found to a step,
    along the axes alone until rooms were turned.
    """
    rng, turned = np.random.default_rng(0), torch.eye(3).double()
    lags = SpectrumLags(ELEMENTS, SphereGrid.hemisphere(24, 48), 1.0)
    places = torch.from_numpy(
        np.c_[rng.uniform(2, 6, 30), rng.uniform(-3, 3, 30), rng.uniform(0.8, 1.6, 30)]
    )
    across, along = np.sin(np.radians(turn)), np.cos(np.radians(turn))
    mirrors = torch.tensor([[-across, along, 0, WALL], [0, 0, 1, CEILING]]).double()
    places[:, :2] = places[:, :2] @ torch.tensor([[along, across], [-across, along]])
    receiver = torch.tensor([0, 0, 1.0])
    directions, distance = directions_and_distances(places, mirrors, receiver.double(), turned)
    power = torch.tensor([1, 0.64, 0.49]) / distance.square()
    seen = (power[..., None] * lags.plane_wave_lags(directions.float())).sum(1)
    found = find_paths(lags, seen, places, receiver.double(), turned).planes
    assert sorted(found[:, 3].tolist()) == pytest.approx([CEILING, WALL], abs=STEP / 2)
    assert float((found[:, :3] @ mirrors[:, :3].T).abs().amax(1).min()) > 0.999


def test_new_places_are_told_by_paths_not_by_averages(room, fitted):
    plain = [error(fit(one, room, LAST), room, LAST) for one in (OtherCarriers(), DirectBeam())]
    assert error(fitted, room, LAST) < 0.7 * min(plain)
    said = fitted.predict(room.batch(LAST))
    squared = (said.mean - room.batch(LAST).target).square().flatten(1).mean(1)
    assert 0.4 < float((squared / said.variance).mean()) < 2.5
    assert said.unknown.shape == (len(LAST),) and (said.unknown > 0.1).all()


@pytest.mark.slow
def test_what_some_carriers_said_of_a_place_tells_the_others(room, fitted):
    rest = LAST[room.station[LAST] >= 3]
    half = fit(CarrierField(), room, rest)
    assert error(half, room, rest) < error(fitted, room, rest)


def test_a_carrier_unlike_all_others_was_told_what_they_saw_at_the_place(room):
    """In the public scene the default was behind the mean image of all other carriers."""
    rng, rows = np.random.default_rng(2), np.arange(len(room)).reshape(-1, CARRIERS)
    mixed = np.empty_like(room.target)
    for own in rows.T:
        mixed[own] = room.target[rng.permutation(own)]
    unlike, test = replace(room, target=mixed), np.flatnonzero(room.station == 2)
    field = fit(CarrierField(), unlike, test)
    mean = np.delete(mixed, test, axis=0).mean(0)
    assert field.carried < 0.5
    assert error(field, unlike, test) < 1.05 * np.square(mixed[test] - mean).mean()


@pytest.mark.slow
def test_a_carrier_that_was_never_measured_is_predicted(room):
    test = np.flatnonzero(room.station == 2)
    method = fit(wrap_per_station(Gsparc(), room), room, test)
    assert isinstance(method.station_method(2).inner, CarrierField)
    assert error(method, room, test) < 0.6 * error(fit(DirectBeam(), room, test), room, test)


def test_a_query_without_a_carrier_is_asked_for_one(fitted):
    with pytest.raises(ValueError, match=r"which carrier\? say station=, one of rx at 1000 MHz"):
        fitted.predict(Query(torch.zeros(1, 3), Pose.identity(torch.zeros(3))))


def test_an_array_that_carriers_see_differently_is_not_one(room):
    assert carriers_obstacle(room.site) is None
    plain = from_arrays(
        {
            "tx_position": room.tx,
            "rx_position": np.zeros(3),
            "spectrum": room.target,
            "carrier_hz": room.carrier_hz,
            "array_position": room.site.array,
        }
    )
    assert carriers_obstacle(plain.site) == "carriers see through different arrays"
    refused("carriers: carriers see through different arrays", fit, CarrierField(), plain, LAST)


@pytest.mark.slow
def test_a_carrier_is_asked_for_by_its_frequency(room):
    """As one held out is answered, another that no station has is:
    by geometry and nearby carriers.
    """
    test = np.flatnonzero(room.station == 2)
    learned = fit(wrap_per_station(Gsparc(), room), room, test)
    predictor = Predictor(learned, room.site)
    known = float(room.site.stations.carrier_hz[2])
    at = room.tx[test[:3]] + room.site.origin
    named = predictor.select_station(2).spectrum(tx=at)
    assert np.array_equal(predictor.spectrum(tx=at, frequency_hz=known), named)
    beside = predictor.spectrum(tx=at, frequency_hz=known * 1.001)
    assert np.abs(beside - named).max() < 0.02  # held out as the one beside it
    assert (
        np.abs(beside - room.target[test[:3]]).mean()
        < np.abs(room.target[test[3:6]] - room.target[test[:3]]).mean()
    )
    assert (
        predictor.select_carrier(known * 8).std(tx=at) >= predictor.select_station(2).std(tx=at)
    ).all()
    assert len(predictor.stations) == CARRIERS  # asking adds none


def test_a_carrier_of_a_model_that_has_none_is_refused(room):
    few = np.arange(0, len(room), 3)
    plain = fit(
        wrap_per_station(GaussianProcess(), room), room, np.setdiff1d(np.arange(len(room)), few)
    )
    with pytest.raises(
        ValueError, match="learned each carrier alone; model=carriers answers at others"
    ):
        Predictor(plain, room.site).select_carrier(7e9)
    network = fit(
        wrap_per_station(method_class("wideband")(count=20, max_steps=3), room), room, few
    )
    with pytest.raises(
        ValueError, match="wideband knows its own carriers alone; model=carriers answers"
    ):
        Predictor(network, room.site).select_carrier(7e9)
    for wrong in (0.0, np.nan, -1e9):
        refused("a frequency above 0", Predictor(plain, room.site).select_carrier, wrong)

"""Spectra of one array at several carriers: paths that all share, what carriers tell of each other."""

from pathlib import Path

import numpy as np
import pytest
import torch

from gsparc.data.datasets.rfid import planar_array
from gsparc.data.own import from_arrays
from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.models.carriers.array import carriers_obstacle
from gsparc.models.carriers.geometry import STEP, find_paths, ways
from gsparc.models.carriers.method import CarrierField
from gsparc.models.carriers.plain import DirectBeam, OtherCarriers
from gsparc.models.gsparc import Gsparc
from gsparc.models.per_station import wrap_per_station
from gsparc.ops import Pose, SphereGrid
from gsparc.physics.array_response import bartlett_spectrum, steering_matrix
from gsparc.physics.lags import SpectrumLags
from gsparc.training.context import FitContext

CARRIERS, PLACES, WALL, CEILING = 5, 30, 4.0, 3.0
HERTZ = np.array([1.0, 2.0, 5.0, 20.0, 60.0]) * 1e9
ELEMENTS = planar_array(spacing_m=0.5)[:, [2, 0, 1]]  # in wavelengths, in the plane yz


@pytest.fixture(scope="module")
def room():
    """Places in sight of an array, a mirror at y = 4 and one at z = 3; phases of paths free."""
    rng, grid = np.random.default_rng(0), SphereGrid.hemisphere(24, 48)
    elements = ELEMENTS
    place = np.c_[rng.uniform(2, 6, PLACES), rng.uniform(-3, 3, PLACES), rng.uniform(0.8, 1.6, PLACES)]
    images = [place, place * [1, -1, 1] + [0, 2 * WALL, 0], place * [1, 1, -1] + [0, 0, 2 * CEILING]]
    away = np.stack(images, 1) - [0.0, 0.0, 1.0]
    distance = np.linalg.norm(away, axis=2)
    response = np.exp(2j * np.pi * away / distance[..., None] @ elements.T)
    gains = np.array([1, 0.8, 0.7]) / distance * np.exp(2j * np.pi * rng.random((CARRIERS, PLACES, 3)))
    vectors = np.einsum("cpk,pkm->pcm", gains, response).reshape(-1, 16)
    spectra = bartlett_spectrum(torch.from_numpy(vectors), steering_matrix(elements, grid, 1.0)).numpy()
    spectra = (spectra / spectra.max(1, keepdims=True)).reshape(-1, 24, 48)
    station = np.tile(np.arange(CARRIERS), PLACES)
    arrays = {
        "tx_position": np.repeat(place, CARRIERS, axis=0), "rx_position": np.array([0.0, 0.0, 1.0]),
        "spectrum": spectra, "carrier_hz": HERTZ[station], "array_position": elements * 0.3,
    }  # fmt: skip
    data = from_arrays(arrays, {"normalisation": "max"})
    # An array half a wavelength apart at each carrier.
    alike = elements * (299_792_458.0 / HERTZ)[:, None, None]
    object.__setattr__(data.site.stations, "array", alike)
    return data


def fit(method, data, test):
    train = np.setdiff1d(np.arange(len(data)), test)
    none = train[:0]
    method.fit(data, Fold(train, none, test), FitContext(Path()))
    return method


def error(method, data, rows):
    batch = data.batch(rows)
    return float((method.predict(batch).mean - batch.target).square().mean())


LAST = np.arange(24 * CARRIERS, 30 * CARRIERS)  # rows of six places


@pytest.fixture(scope="module")
def fitted(room):
    return fit(CarrierField(), room, LAST)


def test_mirrors_were_found_beyond_their_places_where_beams_overlap():
    """Of beams without cross terms they are found to a step: what other paths imitate tells nothing."""
    rng, turned = np.random.default_rng(0), torch.eye(3).double()
    lags = SpectrumLags(ELEMENTS, SphereGrid.hemisphere(24, 48), 1.0)
    places = torch.from_numpy(np.c_[rng.uniform(2, 6, 30), rng.uniform(-3, 3, 30), rng.uniform(0.8, 1.6, 30)])
    mirrors, receiver = (
        torch.tensor([[0, 1, 0, WALL], [0, 0, 1, CEILING]]).double(),
        torch.tensor([0, 0, 1.0]),
    )
    directions, distance = ways(places, mirrors, receiver.double(), turned)
    power = torch.tensor([1, 0.64, 0.49]) / distance.square()
    seen = (power[..., None] * lags.plane_wave_lags(directions.float())).sum(1)
    found = find_paths(lags, seen, places, receiver.double(), turned).planes
    assert sorted(found[:, 3].tolist()) == pytest.approx([CEILING, WALL], abs=STEP / 2)


def test_new_places_are_told_by_paths_not_by_averages(room, fitted):
    plain = [error(fit(one, room, LAST), room, LAST) for one in (OtherCarriers(), DirectBeam())]
    assert error(fitted, room, LAST) < 0.7 * min(plain)
    said = fitted.predict(room.batch(LAST))
    squared = (said.mean - room.batch(LAST).target).square().flatten(1).mean(1)
    assert 0.4 < float((squared / said.variance).mean()) < 2.5
    assert said.unknown.shape == (len(LAST),) and (said.unknown > 0.1).all()


def test_what_some_carriers_said_of_a_place_tells_the_others(room, fitted):
    rest = LAST[room.station[LAST] >= 3]
    half = fit(CarrierField(), room, rest)
    assert error(half, room, rest) < error(fitted, room, rest)


def test_a_carrier_that_was_never_measured_is_predicted(room):
    test = np.flatnonzero(room.station == 2)
    method = fit(wrap_per_station(Gsparc(), room), room, test)
    assert isinstance(method.station_method(2).inner, CarrierField)
    assert error(method, room, test) < 0.6 * error(fit(DirectBeam(), room, test), room, test)


def test_a_stored_method_answers_the_same(room, fitted, tmp_path):
    torch.save(fitted.state(), tmp_path / "state.pt")
    again = CarrierField()
    again.restore(room.site, torch.load(tmp_path / "state.pt", weights_only=True))
    batch = room.batch(LAST)
    for part in ("mean", "variance", "unknown"):
        torch.testing.assert_close(getattr(again.predict(batch), part), getattr(fitted.predict(batch), part))
    assert again.count_components() == fitted.count_components()


def test_a_query_without_a_carrier_is_asked_for_one(fitted):
    with pytest.raises(ValueError, match=r"which carrier\? say station=, one of rx at 1000 MHz"):
        fitted.predict(Query(torch.zeros(1, 3), Pose.identity(torch.zeros(3))))


def test_an_array_that_carriers_see_differently_is_not_one(room):
    assert carriers_obstacle(room.site) is None
    plain = from_arrays({
        "tx_position": room.tx, "rx_position": np.zeros(3), "spectrum": room.target,
        "carrier_hz": room.carrier_hz, "array_position": room.site.array,
    })  # fmt: skip
    assert carriers_obstacle(plain.site) == "carriers see through different arrays"
    with pytest.raises(ValueError, match="carriers: carriers see through different arrays"):
        fit(CarrierField(), plain, LAST)

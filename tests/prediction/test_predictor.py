"""gsparc.load: world coordinates in, the same kind of array out;
levels with covariances of their errors.
"""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused
from towns import town_file

import gsparc
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import from_arrays, load_own
from gsparc.training.context import FitContext


def loaded(data, fold, path, name="gp"):
    method = method_class(name)()
    method.fit(data, fold, FitContext(path))
    checkpoint.save(path / f"{name}.ckpt", method)
    return gsparc.load(path / f"{name}.ckpt")


@pytest.fixture
def spectra(campaign, folds, tmp_path):
    data = campaign("spectrum", 40)
    return data, loaded(data, folds(40).folds[0], tmp_path)


def test_world_positions_many_and_one(spectra):
    data, predictor = spectra
    assert isinstance(predictor.method, GaussianProcess)
    world = data.tx[:3] + data.site.origin
    batch = data.batch(np.arange(3))
    expected = predictor.method.predict(batch)
    many = predictor.spectrum(tx=world)
    assert isinstance(many, np.ndarray) and many.shape == (3, 12, 24) and many.dtype == np.float32
    assert np.allclose(many, expected.mean.numpy(), atol=1e-5)
    one = predictor.spectrum(tx=torch.tensor(world[0]))
    assert isinstance(one, torch.Tensor) and one.shape == (12, 24)
    assert np.allclose(one.numpy(), many[0], atol=1e-6)
    assert isinstance(predictor.spectrum(tx=world[0].tolist()), np.ndarray)
    sure = predictor.confidence(tx=world)
    assert sure.shape == (3,) and np.allclose(sure, expected.confidence.numpy(), atol=1e-4)
    assert isinstance(predictor.confidence(tx=world[0]), float)


def test_static_end_is_known_and_not_moved(spectra):
    data, predictor = spectra
    world, still = data.tx[:2] + data.site.origin, data.rx_position[0] + data.site.origin
    with_pose = gsparc.Pose(torch.tensor(still), torch.eye(3, dtype=torch.float64))
    for rx in (still, np.tile(still, (2, 1)), with_pose):
        assert np.array_equal(
            np.asarray(predictor.spectrum(tx=world, rx=rx)), predictor.spectrum(tx=world)
        )
    refused("rx= differs from where it stood", predictor.spectrum, tx=world, rx=still + 1)


def test_channels_in_physical_units_with_a_moving_receiver(campaign, folds, tmp_path):
    data = campaign("csi", 40, "tx")
    predictor = loaded(data, folds(40).folds[0], tmp_path, "nearest")
    row = folds(40).folds[0].train[0]
    found = predictor.csi(rx=data.rx_position[row] + data.site.origin)
    assert found.shape == (4, 3) and found.dtype == np.complex64
    assert np.allclose(found, data.target[row] * 2, atol=1e-5)  # target_scale
    pose = gsparc.Pose(
        torch.tensor(data.rx_position[[row]] + data.site.origin), torch.eye(3).double()[None]
    )
    assert torch.allclose(predictor.csi(rx=pose), torch.from_numpy(found))


HERE = np.array([3.0, 2, 1])


@pytest.mark.parametrize(
    "said, ends",
    [
        ("tx= is needed", {}),
        ("NaN or Inf in row 1", {"tx": [HERE, HERE * np.nan]}),
        ("shape", {"tx": HERE[:2]}),
        ("shape", {"tx": np.zeros((2, 2, 3))}),
        ("shape", {"tx": np.zeros((0, 3))}),
        ("numbers", {"tx": "here"}),
        ("must be real numbers", {"tx": [1j, 0, 0]}),  # they lost their imaginary part
        (
            "expected metres, none beyond 1e",
            {"tx": [1e300, 0, 0]},
        ),  # beyond float32: answered with NaN
        (
            "holds 2 positions, the other end 3",
            {"tx": np.tile(HERE, (2, 1)), "rx": np.tile(HERE, (3, 1))},
        ),
    ],
)
def test_positions_that_are_none_are_refused(spectra, said, ends):
    refused(said, spectra[1].spectrum, **ends)


def test_wrong_questions_get_clear_answers(spectra, folds, tmp_path):
    refused(r"predicts spectrum \(dataset toy\), not csi: call .spectrum", spectra[1].csi, tx=HERE)
    with pytest.raises(ValueError, match="mean has no confidence"):
        loaded(spectra[0], folds(40).folds[0], tmp_path, Mean.name).confidence(tx=HERE)


def test_names_are_looked_up_on_first_use():
    assert "load" in dir(gsparc)
    with pytest.raises(AttributeError, match="lod"):
        gsparc.lod  # noqa: B018


def test_other_frequencies_than_the_one_measured_are_refused(campaign, folds, tmp_path):
    """One tone was repeated at whatever frequency was asked for,
    with a phase that belongs to another.
    """
    data = campaign("csi", 30, "tx")
    site = dataclasses.replace(data.site, subcarriers_hz=np.array([2.4e9]))
    data = dataclasses.replace(data, site=site, target=data.target[:, :, :1])
    predictor = loaded(data, folds(30).folds[0], tmp_path)
    place = data.rx_position[0] + data.site.origin
    assert np.array_equal(predictor.csi(rx=place, frequency_hz=2.4e9)[0], predictor.csi(rx=place))
    refused(
        r"measured at 2400\.000 MHz alone", predictor.csi, rx=place, frequency_hz=[2.4e9, 2.41e9]
    )


@pytest.fixture
def abroad(tmp_path):
    """Powers of one transmitter at a known place, in degrees, 1.5 m above ground."""
    rng = np.random.default_rng(0)
    data = from_arrays(
        {
            "latitude": 47 + rng.uniform(0, 0.01, 40),
            "longitude": 11 + rng.uniform(0, 0.01, 40),
            "rx_height": np.array(1.5),
            "station_latitude": np.array([47.001, 47.001]),
            "station_longitude": np.array([11.0, 11.0]),
            "station_height": np.array(9.0),
            "carrier_hz": np.array([9e8, 1.8e9]),
            "rssi_db": rng.normal(0, 1, (40, 2)) - [50, 80],
        }
    )
    method = wrap_per_station(GaussianProcess(), data)
    rows = np.arange(len(data))
    method.fit(data, Fold(rows, rows[:0], rows[:4]), FitContext(tmp_path))
    checkpoint.save(tmp_path / "gp.ckpt", method)
    return gsparc.load(tmp_path / "gp.ckpt")


def test_degrees_to_metres_and_back(abroad):
    place = abroad.metres(47.004, 11.002)
    assert place.shape == (3,) and place[2] == 1.5  # the height at which it was measured
    many = abroad.metres([47.004, 47.005], [11.002, 11.003], height=[1.0, 2.0])
    assert many.shape == (2, 3) and np.array_equal(many[0, :2], place[:2])
    latitude, longitude, height = abroad.degrees(many)
    assert np.allclose(latitude, [47.004, 47.005], atol=1e-10) and np.allclose(
        longitude, [11.002, 11.003]
    )
    assert height.tolist() == [1, 2] and abroad.degrees(place)[2] == 1.5
    assert isinstance(abroad.select_station(0).rssi(rx=place)[0], np.float32)


def test_degrees_that_mean_nothing_are_refused(abroad, spectra):
    refused("latitude 95 is outside", abroad.metres, 95, 11)
    refused(r"height= must be one number or 2 \[m\]", abroad.metres, [47, 47], [11, 11], [1, 2, 3])
    refused("toy was measured in metres about an unknown origin", spectra[1].metres, 47, 11)
    refused("unknown origin", spectra[1].degrees, np.zeros(3))
    several = dataclasses.replace(abroad.site, moving_box=abroad.site.moving_box - np.eye(2, 3, 2))
    refused("height= is needed", gsparc.Predictor(abroad.method, several).metres, 47, 11)


def test_utm_places_in_float32_were_half_a_metre_off(abroad):
    """The origin is taken away in float64, but steps of 5,000 km in float32 are 0.5 m:
    phases were lost.
    """
    utm = np.array([691_500.0, 5_334_500, 0])
    site = dataclasses.replace(abroad.site, origin=abroad.site.origin + utm)
    far, place = (
        gsparc.Predictor(abroad.method, site).select_station(0),
        abroad.metres(47.004, 11.002),
    )
    there = place + utm
    assert np.allclose(far.rssi(rx=there), abroad.select_station(0).rssi(rx=place), atol=1e-4)
    for rough in (torch.tensor(there, dtype=torch.float32), there.astype(np.float32)):
        refused(
            r"rx= is float32, which moves in steps of 0.5 m there; give float64", far.rssi, rx=rough
        )
    abroad.select_station(0).rssi(rx=place.astype(np.float32))


def test_two_stations_at_one_place_have_models_of_their_own(abroad):
    """Both carriers of a mast were answered by the model of the first."""
    place = abroad.metres(47.004, 11.002)
    low, high = (float(abroad.select_station(number).rssi(rx=place)[0]) for number in (0, 1))
    assert 25 < low - high < 35


def test_a_cell_as_tables_print_it_was_no_station(abroad):
    """`W03-2 (150)`: its name and its label were taken, both together refused."""
    stations = dataclasses.replace(abroad.site.stations, label=("W03-1", "W03-2"))
    shown = [f"{label} ({name})" for label, name in zip(stations.label, stations.name, strict=True)]
    site = dataclasses.replace(abroad.site, stations=stations)
    city, place = gsparc.Predictor(abroad.method, site), abroad.metres(47.004, 11.002)
    assert city.stations == shown
    for names in (shown, stations.label, stations.name):
        columns = [float(city.select_station(name).rssi(rx=place)[0]) for name in names]
        assert np.allclose(columns, np.ravel(city.rssi(rx=place)), atol=1e-4)
    refused(re.escape(f"there are {', '.join(shown)}"), city.select_station, "W03-3")


def test_all_at_once_is_what_is_asked_one_by_one(abroad):
    one, places = abroad.select_station(1), abroad.metres([47.004, 47.008], [11.002, 11.009])
    said = one.predict(rx=places)
    assert np.array_equal(said.mean.float().numpy(), one.rssi(rx=places))
    assert np.array_equal(said.confidence.numpy(), one.confidence(rx=places))
    assert np.allclose(said.variance.sqrt()[:, None], one.std(rx=places), rtol=1e-6)
    assert (np.abs(one.std(rx=places) - 1) < 0.5).all()  # a decibel, as the powers were drawn


@pytest.mark.parametrize("model", ["complex_gp", "nearest"])
def test_channels_of_all_stations_took_a_call_each(model):
    """42 antennas that stand said `use select_station`, and 42 calls made equal matrices anew."""
    draw = np.random.default_rng(0)
    places, stations = draw.uniform(0, 2, (60, 3)), draw.uniform([0, 0, 3], [2, 2, 5], (3, 3))
    far = np.linalg.norm(places[:, None] - stations, axis=2)
    known = {
        "station_position": stations,
        "csi": np.exp(-1j * 20 * far) / far,
        "frequency_hz": [955e6],
    }
    predictor = gsparc.fit(tx=places, model=model, align="none", **known)
    each = [predictor.select_station(name) for name in predictor.stations]
    where = {"tx": places[:4] + 0.01}
    channels = predictor.csi(**where)
    assert channels.shape == (4, 3, 1, 1)
    assert np.array_equal(channels, np.stack([one.csi(**where) for one in each], 1))
    assert predictor.csi(tx=places[0]).shape == (3, 1, 1)
    assert predictor.csi(**where, symbols=14).shape == (4, 3, 1, 1, 1, 14, 1)
    said = predictor.predict(**where)
    assert np.array_equal(said.mean.numpy(), channels)
    if said.variance is not None:
        spread = predictor.std(**where)
        assert spread.shape == (4, 3, 1, 1) and np.allclose(said.variance.sqrt(), spread[..., 0, 0])
        assert np.allclose(spread, np.stack([one.std(**where) for one in each], 1))
    refused(r"use select_station\(name\): one of", predictor.paths, **where)


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
        np.testing.assert_allclose(
            own.diagonal() + scatter, covariance[:, number, number], rtol=1e-6
        )
        assert own[0, 1] > own[0, 2], "errors of neighbours are alike"
    pairs = np.repeat(PLACES[:, None], len(numbers), 1)
    np.testing.assert_array_equal(predictor.predict_joint(pairs, numbers)[1], covariance)


def test_who_knows_no_covariance_says_so():
    with pytest.raises(ValueError, match="states none of errors"):
        gsparc.load(STORED / "kriging.ckpt").covariance(rx=PLACES)
    assert gsparc.load(STORED / "stations-each.ckpt").predict_joint(PLACES, [0]) is None


def test_a_plan_of_stations_learned_together_was_an_error_of_shapes(tmp_path):
    """`gsparc plan` of `model=gp stations=together` ended in "size of tensor a (3)
    must match b (0)".
    """
    data = load_own(town_file(tmp_path / "town.npz"))
    method, rows = wrap_per_station(method_class("gp")(), data), np.arange(0, len(data), 7)
    method.fit(data, Fold(rows, rows[:0], rows[:1]), FitContext(tmp_path, stations="together"))
    one = Predictor(method, data.site).select_station(data.site.stations.name[0])
    covariance, noise = one.covariance(**{data.site.moving_end: PLACES})
    assert covariance.shape == (3, 3) and covariance[0, 1] > covariance[0, 2] and noise > 0


LEARNING = "lightning torch._dynamo torchmetrics matplotlib pandas sklearn scipy.stats"
ASK = """import sys, gsparc
gsparc.load(sys.argv[1]).predict(tx=[[3.0, 2, 1]])
print(*(name for name in sys.argv[2:] if name in sys.modules))"""


@pytest.mark.parametrize("name, settings", [("gp", {}), ("splat", {"steps": 0})])
def test_what_trains_and_reads_tables_was_loaded_to_answer(
    name, settings, campaign, folds, tmp_path
):
    """Five seconds and 580 MB, most of them Lightning's, pandas' and scikit-learn's."""
    method = method_class(name)(**settings)
    method.fit(campaign("spectrum", 40), folds(40).folds[0], FitContext(tmp_path))
    checkpoint.save(tmp_path / "model.ckpt", method)
    asked = [sys.executable, "-c", ASK, tmp_path / "model.ckpt", *LEARNING.split()]
    done = subprocess.run(asked, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stdout.split(), done.stdout + done.stderr

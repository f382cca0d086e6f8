"""The method end to end on rooms whose every source is known."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from gains import fitted
from invented import invent
from refusals import refused
from rooms import WAVELENGTH, nmse, shoebox
from scenes import error
from shoeboxes import as_arrays

from gsparc import load
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.mixture.methods import ImageSources
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


def _predicted(method, data, index):
    batch = data.batch(index)
    return method.predict(batch)


def found_share(method, told, within=0.1, order=2):
    """Share of the true sources of at most `order` reflections that every search found."""
    true = told.images.mirror_points(told.tx[0])[told.images.order <= order]
    shares = []
    for member in method.members:
        places = (member.scene.sources + method.frame.middle).numpy() + method.site.origin
        nearest = np.linalg.norm(true[:, None] - places[None], axis=-1).min(1)
        shares.append((nearest < within * WAVELENGTH).mean())
    return min(shares)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    torch.manual_seed(0)
    told, data, fold = shoebox(150, size=(3.0, 2.5, 2.2), max_order=1)
    return told, data, fold, *fitted(data, fold, tmp_path_factory.mktemp("run"))


@pytest.mark.slow
def test_first_order_images_are_found_and_the_channel_extrapolates(small):
    told, data, fold, method, report = small
    assert found_share(method, told, order=1) == 1.0 and method.count_components() >= 7
    assert "1 of 1 searches" in report.notes[0] and report.seconds > 0
    assert error(method, data, fold.test) < 0.01


def test_rows_factored_in_float32_answered_otherwise_on_other_machines(small):
    """By up to 3e-4 of the deviation."""
    query, members = small[3].query, [member.in_float64 for member in small[3].members]
    exact = torch.cat(
        [one.dual_weights.sum(1) * one.scene.phase_factors[:, None] for one in members]
    )
    constant = members[0].scene.visibility.constant
    known = torch.view_as_real(exact).flatten(1)[:, None] * constant
    assert (query.level - known).abs().max() < 1e-7 * known.abs().max()


def test_paths_sum_to_the_prediction(small, tmp_path):
    """Gains, delays and directions are what `predict` adds up;
    the loudest comes from the transmitter.
    """
    _, data, fold, method, _ = small
    checkpoint.save(tmp_path / "m.ckpt", method)
    predictor = load(tmp_path / "m.ckpt")
    world = data.moving[fold.test[:5]] + data.site.origin
    found = predictor.paths(rx=world)
    summed = found.channel(data.site.subcarriers_hz)
    assert np.allclose(summed, predictor.csi(rx=world), atol=1e-3 * np.abs(summed).max())
    loudest = np.abs(found.gain[:, 0]).argmax(1)
    towards = data.tx[fold.test[:5]] - data.moving[fold.test[:5]]
    distance = np.linalg.norm(towards, axis=1)
    rows = np.arange(5)
    assert np.abs((found.direction[rows, loudest] * towards).sum(1) / distance - 1).max() < 1e-3
    assert np.abs(found.delay_s[rows, 0, loudest] * 299_792_458.0 - distance).max() < 0.05


def test_a_reflection_that_two_solutions_found_was_two_paths(small):
    """Before, paths were those of the heaviest solution."""
    _, data, fold, method, _ = small
    other = copy.deepcopy(method)
    other.frame = replace(other.frame, scale=0.5 * other.frame.scale)
    model = ImageSources()
    model.site, model.members, model.weights = data.site, [method, other], (0.6, 0.4)
    predictor, world = Predictor(model, data.site), data.moving[fold.test[:5]] + data.site.origin
    channel, found = predictor.csi(rx=world), predictor.paths(rx=world)
    assert (
        found.direction.shape[1]
        == found.gain.shape[2]
        == found.delay_s.shape[2]
        == method.count_components()
    )
    summed = found.channel(data.site.subcarriers_hz)
    assert np.abs(summed - channel).max() < 1e-3 * np.abs(channel).max()


def test_without_a_query_there_was_an_error(small):
    """Its variance was reshaped to a size of -1."""
    _, data, _, method, _ = small
    assert _predicted(method, data, np.zeros(0, np.int64)).mean.shape == (0, 1, 1)


def test_two_searches_at_the_noise_floor_are_enough(tmp_path):
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    method, report = fitted(data, fold, tmp_path, searches=8, search_rows=60, margin=1.0)
    assert "of 8 searches (two agree up to noise, which is enough)" in report.notes[0]
    # both threads may have started one more when the second ended
    assert 2 <= len(method.members) <= 2 + torch.get_num_threads()


def test_spectra_and_zero_channels_are_refused_in_one_line(tmp_path):
    """Of zero channels the library's sequences about a matrix
    that is not positive definite came.
    """
    fold = Fold(np.arange(30), np.arange(30, 36), np.arange(36, 48))
    refused(
        "needs complex channels",
        ImageSourceGP().fit,
        invent("spectrum"),
        fold,
        FitContext(tmp_path),
    )
    refused("not fitted", ImageSourceGP().state)
    _, data, fold = shoebox(40, size=(3.0, 2.5, 2.2), max_order=1)
    silent = replace(
        data, target=np.where(np.arange(40)[:, None, None] == fold.test[0], data.target, 0)
    )
    refused("every training channel is zero", fitted, silent, fold, tmp_path)


@pytest.mark.slow
def test_every_source_of_a_shoebox_is_found(tmp_path):
    """2.4 GHz, 450 receivers in 30 m^3, nearest neighbours about two wavelengths apart, 30 dB."""
    told, data, fold = shoebox(450)
    method = ImageSourceGP(searches=1)
    method.fit(data, fold, FitContext(tmp_path))
    assert found_share(method, told) >= 0.9 and error(method, data, fold.test) <= 0.01


@pytest.mark.slow
def test_scatterers_are_found_beside_images(tmp_path):
    """In a room of weak walls; a scattered wave has both legs, 1 / (d1 d2)."""
    true = np.array([[2.3, 0.9, 0.8], [1.1, 1.9, 1.2]])
    told, _, fold = shoebox(220, size=(3.0, 2.5, 2.2), max_order=1, reflection=-0.4)
    before = np.linalg.norm(true - told.tx[0], axis=1)
    after = np.linalg.norm(told.rx[:, None] - true[None], axis=-1)
    waves = (np.exp(-2j * np.pi * (before + after) / WAVELENGTH) / before / after).sum(1)
    arrays = as_arrays(told)
    arrays["csi"] = arrays["csi"] + 0.5 * waves[:, None, None] * WAVELENGTH / (4 * np.pi)
    data = from_arrays(arrays)
    method, _ = fitted(data, fold, tmp_path, clutter=False, search_rows=220, margin=4.0)
    places = (method.members[0].scene.sources + method.frame.middle).numpy() + data.site.origin
    images = told.images.mirror_points(told.tx[0])[told.images.order == 1]
    for wanted, within in ((true, 0.1), (images, 0.3)):
        assert (
            np.linalg.norm(wanted[:, None] - places[None], axis=-1).min(1) < within * WAVELENGTH
        ).all()
    assert error(method, data, fold.test) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "offsets",
    [*(pytest.param(one, marks=pytest.mark.rare) for one in ("none", "phase")), "phase_timing"],
)
def test_sources_are_found_through_unknown_offsets_that_are_estimated(offsets, tmp_path):
    """After one free complex number per sample: unseen snapshots have unknown phases too."""
    rng, tones = np.random.default_rng(0), 2.4e9 + np.arange(16) * 5e6
    _, data, fold = shoebox(
        150, size=(3.0, 2.5, 2.2), max_order=1, frequency_hz=tones, reflection=-0.5
    )
    delay = rng.uniform(-20e-9, 20e-9, (150, 1)) * (offsets == "phase_timing")
    turn = rng.uniform(-np.pi, np.pi, (150, 1)) - 2 * np.pi * delay * (tones - data.site.carrier_hz)
    seen = replace(data, target=(data.target * np.exp(1j * turn)[:, None]).astype(np.complex64))
    method, _ = fitted(seen, fold, tmp_path, search_rows=300, offsets=offsets)
    batch = data.batch(fold.test)
    found, true = method.predict(batch).mean.numpy(), batch.target.numpy()
    scalar = (found.conj() * true).sum((1, 2)) / (np.abs(found) ** 2).sum((1, 2))
    if offsets == "none":
        assert nmse(found, true) > 0.5
    else:
        assert nmse(found * scalar[:, None, None], true) < 0.01


def test_unknown_kind_of_offset_is_refused():
    refused("phase_timing", ImageSourceGP, offsets="both")

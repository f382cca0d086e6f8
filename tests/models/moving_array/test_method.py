"""The moving-array model on exact rooms:
it must find the image sources and render them from anywhere.
"""

import dataclasses

import numpy as np
import pytest
import torch
from boxes import ROOM, TRANSMITTER, room_of_spectra
from closed import read_back
from scipy.optimize import nnls

from gsparc.data.query import Query
from gsparc.data.splits import SplitSettings, make_split
from gsparc.evaluation.scores import score_methods
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import (
    SearchSettings,
    find_sources,
    nonnegative_powers,
    site_problem,
)
from gsparc.physics.lags import SpectrumLags
from gsparc.simulate.shoebox import mirror_images
from gsparc.training.context import FitContext

ROWS = np.arange(0, 160, 2)
SEARCH = SearchSettings(sources=17, rows=50, candidates=4000, steps=80)


@pytest.fixture(scope="module")
def data():
    return room_of_spectra()


@pytest.fixture(scope="module")
def split(data):
    return make_split(data.moving, SplitSettings(test_fraction=0.3))


@pytest.fixture(scope="module")
def fold(split):
    return split.folds[0]


@pytest.fixture(scope="module")
def fitted(data, fold, tmp_path_factory):
    method = MovingArrayField(search=SEARCH, components=64)
    assert method.fit(data, fold, FitContext(tmp_path_factory.mktemp("run"))).seconds > 0
    return method


@pytest.fixture
def field(data, fitted):
    """A copy of its own, with all that conditioning leaves."""
    again = read_back(fitted)
    again.condition(data, ROWS)
    return again


def missed(field, data, rows):
    batch = data.batch(rows)
    return float((field.predict(batch).mean - batch.target).square().mean())


@pytest.mark.slow
def test_the_mean_is_what_sources_explain_and_the_residual(data, field):
    assert field.terms == ("moving_array", "residual")
    np.testing.assert_array_equal(field.found.sources[0], np.float32(data.site.static_position))
    batch = data.batch(np.arange(1, 31, 2))
    posterior = field.predict(batch)
    explained, mean, energy, _ = field.renderer()(batch.places(data.site))
    torch.testing.assert_close(posterior.explained, explained.clamp(0, 1))
    added = field.basis.project(mean - explained)
    torch.testing.assert_close(added.square().sum(1), energy, rtol=1e-3, atol=1e-6)
    whole = (explained + field.basis.images(added)).clamp(0, 1)
    torch.testing.assert_close(posterior.mean, whole, rtol=0, atol=1e-4)
    alone = float((explained.clamp(0, 1) - batch.target).square().mean())
    assert missed(field, data, np.arange(1, 160, 2)) < alone
    assert posterior.variance.shape == posterior.unknown.shape == (15,)


def test_more_rows_condition_it_better(data, field):
    places, test = field.found.sources.clone(), np.arange(1, 160, 4)
    before = missed(field, data, test)
    field.condition(data, np.concatenate([ROWS, np.arange(3, 160, 4)]))
    assert missed(field, data, test) < before
    assert len(field.left_out().rows) == 120 and torch.equal(places, field.found.sources)
    field.condition(data, ROWS)
    assert missed(field, data, test) == pytest.approx(before, rel=1e-3)


def test_left_out_rows_are_about_as_wrong_as_new_ones(data, field):
    left = field.left_out()
    np.testing.assert_array_equal(left.rows, ROWS)
    error = (left.mean - data.batch(ROWS).target).square().mean((1, 2))
    torch.testing.assert_close(left.variance, error, rtol=1e-4, atol=1e-7)
    assert 0.5 < float(error.mean()) / missed(field, data, np.arange(1, 160, 2)) < 2


@pytest.mark.slow
def test_the_strong_images_are_found(data):
    """The transmitter and images in the near walls, from pictures alone;
    the far ones are 14 dB weaker.
    """
    site = data.site
    space = SpectrumLags(site.array, site.grid, site.wavelength)
    power = torch.from_numpy(data.target[:60].astype(np.float32) / 255) ** 2
    receivers = torch.from_numpy(data.moving[:60]).float()
    given = space.to_lags(power), receivers, None, torch.eye(3), space, site.grid, SEARCH, 0
    found = find_sources(*given)
    mirrored = mirror_images(ROOM, 1).mirror_points(TRANSMITTER)
    above = mirrored[mirrored[:, 2] > 0] - site.origin
    distance = np.linalg.norm(above[:, None] - found.numpy()[None], axis=-1).min(1)
    assert distance[0] < 0.1 and (distance < 0.25).sum() >= 3


def test_an_effort_multiplies_the_steps_of_a_search(data, split, tmp_path, monkeypatch):
    steps = []

    def found(*given):
        steps.append(given[6].steps)
        raise StopIteration

    monkeypatch.setattr("gsparc.models.moving_array.method.find_sources", found)
    for effort in (0.5, 2.0):
        with pytest.raises(StopIteration):
            MovingArrayField(search=SEARCH).fit(
                data, split.folds[0], FitContext(tmp_path, effort=effort)
            )
    assert steps == [SEARCH.steps / 2, 2 * SEARCH.steps]


def test_it_beats_the_process_on_images_and_states_its_error(data, split, fitted, tmp_path):
    rival = GaussianProcess()
    rival.fit(data, split.folds[0], FitContext(tmp_path))
    ours, theirs = (score_methods((m,), data, split, "test") for m in (fitted, rival))
    assert (
        ours.figures()["psnr_db"] > theirs.figures()["psnr_db"] + 0.5
        and fitted.count_components() > 5
    )
    assert 0.4 < ours.variance.mean() / ours.samples["mse"].mean() < 2.5
    assert ours.confidence.min() > 0 and ours.confidence.max() < 1
    near = data.batch(split.folds[0].train[:8])
    far = dataclasses.replace(near.rx, position=near.rx.position + torch.tensor([20.0, 0, 0]))
    here, there = fitted.predict(near), fitted.predict(Query(near.tx, far))
    assert (here.confidence > there.confidence).all() and (here.variance < there.variance).all()
    assert torch.isfinite(there.mean).all() and there.mean.min() >= 0 and there.mean.max() <= 1


def test_powers_are_the_best_that_are_not_negative():
    rng = np.random.default_rng(0)
    atoms, lags = (torch.from_numpy(rng.normal(size=s)).float() for s in ((3, 6, 20), (3, 20)))
    found = nonnegative_powers(lags, atoms, 0.1).numpy()
    for row, one, asked in zip(found, atoms.numpy(), lags.numpy(), strict=True):
        stacked = np.vstack([one.T, np.sqrt(0.1) * np.eye(6)])
        np.testing.assert_allclose(row, nnls(stacked, np.r_[asked, np.zeros(6)])[0], atol=1e-3)


def test_power_spectra_are_recognised(fold, tmp_path):
    method = MovingArrayField(search=dataclasses.replace(SEARCH, sources=9, steps=0), components=0)
    method.fit(room_of_spectra(power=True), fold, FitContext(tmp_path))
    assert method.exponent == 1 and method.residual.axes.shape[0] == 0


def test_unusable_data_are_refused(data, fold, fitted, tmp_path):
    def refused(words, **changes):
        site = dataclasses.replace(data.site, **changes)
        with pytest.raises(ValueError, match=words):
            MovingArrayField().fit(dataclasses.replace(data, site=site), fold, FitContext(tmp_path))

    refused("moving receiver", static_end="rx")
    refused("no array", array=None)
    assert site_problem(data) is None
    with pytest.raises(ValueError, match="empty"):
        read_back(fitted).condition(data, ROWS[:0])
    turned = data.rx_rotation.copy()
    turned[3] = np.diag([-1.0, -1.0, 1.0])
    with pytest.raises(ValueError, match="one orientation"):
        MovingArrayField().fit(
            dataclasses.replace(data, rx_rotation=turned), fold, FitContext(tmp_path)
        )
    noise = np.random.default_rng(0).integers(0, 255, data.target.shape).astype(np.uint8)
    with pytest.raises(ValueError, match="cannot have measured"):
        MovingArrayField().fit(dataclasses.replace(data, target=noise), fold, FitContext(tmp_path))

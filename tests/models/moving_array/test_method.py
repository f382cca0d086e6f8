"""The moving-array model on exact rooms:
it must find the image sources and render them from anywhere.
"""

import dataclasses

import numpy as np
import pytest
import torch
from boxes import ROOM, TRANSMITTER, room_of_spectra
from scipy.optimize import nnls

from gsparc.data.query import Query
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import make_split
from gsparc.evaluation.scores import score_methods
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import (
    SearchSettings,
    find_sources,
    nonnegative_powers,
)
from gsparc.physics.lags import SpectrumLags
from gsparc.simulate.shoebox import mirror_images
from gsparc.training.context import FitContext

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

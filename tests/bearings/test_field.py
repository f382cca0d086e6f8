"""The field of bearings on exact rooms: it must find the images and see them from anywhere."""

import dataclasses

import numpy as np
import pytest
import torch
from boxes import ROOM, TRANSMITTER, room_of_spectra

from gsparc.bearings.field import BearingField
from gsparc.bearings.lags import Lags
from gsparc.bearings.sources import SearchSettings, find_sources
from gsparc.data.splits import SplitSettings, make_split
from gsparc.ops import SphereGrid
from gsparc.peers.gp import GaussianProcess
from gsparc.scoring import score
from gsparc.simulate.shoebox import images

SEARCH = SearchSettings(sources=17, rows=50, candidates=4000, steps=80)


@pytest.fixture(scope="module")
def data():
    return room_of_spectra()


@pytest.fixture(scope="module")
def fold(data):
    return make_split(data.moving, SplitSettings(test_fraction=0.3)).folds[0]


@pytest.fixture(scope="module")
def fitted(data, fold, tmp_path_factory):
    method = BearingField(search=SEARCH, components=64)
    assert method.fit(data, fold, tmp_path_factory.mktemp("run")).seconds > 0
    return method


def test_the_strong_images_are_found(data):
    """The transmitter and images in the near walls, from pictures alone; the far ones are 14 dB weaker."""
    site = data.site
    space = Lags(site.array, site.grid, site.wavelength)
    power = torch.from_numpy(data.target[:60].astype(np.float32) / 255) ** 2
    receivers = torch.from_numpy(data.moving[:60]).float()
    found = find_sources(space.of(power), receivers, None, torch.eye(3), space, site.grid, SEARCH, seed=0)
    mirrored = images(ROOM, 1).of(TRANSMITTER)
    above = mirrored[mirrored[:, 2] > 0] - site.origin
    distance = np.linalg.norm(above[:, None] - found.numpy()[None], axis=-1).min(1)
    assert distance[0] < 0.1 and (distance < 0.25).sum() >= 3


def test_it_sees_better_than_a_process_on_images(data, fold, fitted, tmp_path):
    rival = GaussianProcess()
    rival.fit(data, fold, tmp_path)
    split = make_split(data.moving, SplitSettings(test_fraction=0.3))
    ours, theirs = (score((m,), data, split, "test").figures() for m in (fitted, rival))
    assert ours["psnr_db"] > theirs["psnr_db"] + 0.5 and fitted.size() > 5


def test_confidence_falls_away_from_the_measurements(data, fold, fitted):
    near = data.batch(fold.train[:8])
    far = dataclasses.replace(near.rx, position=near.rx.position + torch.tensor([20.0, 0, 0]))
    here, there = fitted.predict(near.tx, near.rx), fitted.predict(near.tx, far)
    assert (here.confidence > there.confidence).all() and (here.variance < there.variance).all()
    assert torch.isfinite(there.mean).all() and there.mean.min() >= 0 and there.mean.max() <= 1


def test_a_stored_field_says_the_same(data, fold, fitted, tmp_path):
    batch = data.batch(fold.test)
    torch.save(fitted.state(), tmp_path / "state.pt")
    again = BearingField()
    again.restore(data.site, torch.load(tmp_path / "state.pt", weights_only=True))
    one, two = (m.predict(batch.tx, batch.rx) for m in (fitted, again))
    torch.testing.assert_close(one.mean, two.mean)
    torch.testing.assert_close(one.confidence, two.confidence)


def test_power_spectra_are_recognised(fold, tmp_path):
    method = BearingField(search=dataclasses.replace(SEARCH, sources=9, steps=0), components=0)
    method.fit(room_of_spectra(scale="power"), fold, tmp_path)
    assert method.exponent == 1 and method.axes.shape[0] == 0


def test_what_it_cannot_do_is_said(data, fold, tmp_path):
    def refused(words, **changes):
        site = dataclasses.replace(data.site, **changes)
        with pytest.raises(ValueError, match=words):
            BearingField().fit(dataclasses.replace(data, site=site), fold, tmp_path)

    refused("moving receiver", static_end="rx")
    refused("which array", array=None)
    turned = data.rx_rotation.copy()
    turned[3] = np.diag([-1.0, -1.0, 1.0])
    with pytest.raises(ValueError, match="one orientation"):
        BearingField().fit(dataclasses.replace(data, rx_rotation=turned), fold, tmp_path)
    rng = np.random.default_rng(0)
    noise = dataclasses.replace(data, target=rng.integers(0, 255, data.target.shape).astype(np.uint8))
    with pytest.raises(ValueError, match="cannot have measured"):
        BearingField(search=SEARCH).fit(noise, fold, tmp_path)


def test_grid_is_the_sites_own():
    grid = SphereGrid.hemisphere(30, 120)
    assert room_of_spectra(count=20).site.grid == grid

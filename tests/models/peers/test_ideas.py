"""Each peer on a scene where its own idea must work."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import answer_error, error, lobes, room, shadowed, wandering
from scipy.special import eval_legendre

from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.models.baselines.kriging import fit_variogram
from gsparc.models.peers.gsrf import count_terms, fourier_legendre
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.ops import Pose, SphereGrid
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


def fitted(name, data, fold, tmp_path, **settings):
    torch.set_num_threads(1)
    method = method_class(name)(**settings)
    method.fit(data, fold, FitContext(tmp_path))
    return method


def test_fourier_legendre_is_what_it_says():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    series = fourier_legendre(directions, 4, 3)
    assert series.shape == (50, count_terms(4, 3))
    x, y, z = directions.numpy().T
    wanted = eval_legendre(4, z) * np.sin(2 * np.arctan2(y, x))
    assert np.allclose(series[:, 4 * 7 + 4], wanted)


def test_gsrf_lets_opposite_phases_cancel(tmp_path):
    """Real Gaussians in one place can only add up."""
    data, fold = lobes(tmp_path)
    method = fitted("gsrf", data, fold, tmp_path, count=2, max_steps=1, degree=1, order=1)
    net = method.network
    with torch.no_grad():
        net.field.means[:] = torch.as_tensor(data.rx_position[0]) + torch.tensor(
            [[0, 0, 2.0], [0, 0, 2.001]]
        )
        # 0.5 of the first, the rest of the second
        net.field.opacity_logits[:] = torch.tensor([0.0, 8.0])
        net.coefficients[:] = 0
        net.coefficients[0, 0, 0] = 1.0
    batch, brightest = data.batch(fold.test[:1]), []
    for phase in (1.0, -1.0):
        with torch.no_grad():
            net.coefficients[1, 0, 0] = phase
            brightest.append(float(net(batch).max()))
    assert brightest[1] < 0.35 * brightest[0]


@pytest.mark.parametrize(
    ("name", "settings", "share"),
    [
        ("gsrf", {"count": 60, "max_steps": 150, "rate": 8e-3}, 0.75),
        pytest.param(
            "nerf2",
            {
                "width": 32,
                "depth": 4,
                "samples": 12,
                "rays": 512,
                "octaves": 2,
                "max_steps": 800,
                "rate": 5e-3,
            },
            0.75,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_lobes_that_come_and_go_are_learned(tmp_path, name, settings, share):
    data, fold = lobes(tmp_path)
    known = error(fitted("mean", data, fold, tmp_path), data, fold.test)
    assert error(fitted(name, data, fold, tmp_path, **settings), data, fold.test) < share * known


@pytest.mark.slow
@pytest.mark.parametrize(("name", "share"), [("swiftwrf", 0.05), ("wrfgs", 0.15)])
def test_deformed_gaussians_follow_what_moves(tmp_path, name, share):
    """A few Gaussians are enough when they move along;
    standing still they would show the mean picture.
    """
    data, fold = wandering()
    known = error(fitted("mean", data, fold, tmp_path), data, fold.test)
    method = fitted(
        name, data, fold, tmp_path, count=40, max_steps=150, batch_size=8, rate=8e-3, octaves=1
    )
    assert error(method, data, fold.test) < share * known


@pytest.mark.slow
def test_a_carrier_that_nothing_was_learned_from_is_between_its_neighbours(tmp_path):
    """Lobes that come and go with the carrier:
    a network that did not read it would show their mean.
    """
    carrier = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    place = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (24, 3))
    towards = SphereGrid.hemisphere(12, 24).directions().numpy()
    lobes = np.exp(8 * (np.stack([towards @ axis for axis in np.eye(3)[:2]], -1) - 1))  # (H, W, 2)
    octave = np.tile(np.log2(carrier) / 4, len(place))
    spectrum = (lobes @ np.stack([octave, 1 - octave])).transpose(2, 0, 1).astype(np.float32)
    arrays = {
        "tx_position": np.repeat(place, 5, axis=0),
        "rx_position": np.zeros(3),
        "spectrum": spectrum,
    }
    data = from_arrays({**arrays, "carrier_hz": np.tile(carrier, len(place)) * 1e9})
    rows = np.arange(len(data))
    fold = Fold(rows[rows % 5 != 1], rows[:0], rows[rows % 5 == 1])
    settings = {"count": 40, "max_steps": 500, "batch_size": 8, "octaves": 2}
    method = wrap_per_station(method_class("wideband")(**settings), data)
    method.fit(data, fold, FitContext(tmp_path))
    tested = spectrum[fold.test]
    mean = np.square(spectrum[fold.train].mean(0) - tested).sum() / np.square(tested).sum()
    assert answer_error(method, data, fold.test) < 0.3 * mean


@pytest.mark.slow
def test_ngrf_finds_the_waves_of_a_room_that_interpolation_cannot(tmp_path):
    data, fold, _ = room(160)
    plain = error(fitted("gp", data, fold, tmp_path), data, fold.test)
    method = fitted("ngrf", data, fold, tmp_path, count=30, max_steps=400, rate=5e-3)
    assert error(method, data, fold.test) < min(0.5 * plain, 0.3)


def test_rays_that_meet_by_chance_are_no_virtual_transmitter():
    """Of 126 in a conference room 100 had fewer than five rays,
    some of them taken from the true ones.
    """
    data, _, sources = room(60, directions=True)
    rays = [d.astype(float) for d in data.directions]
    for i in (0, np.linalg.norm(data.rx_position[1:] - data.rx_position[0], axis=1).argmin() + 1):
        towards = sources.mean(0) + np.array([0.3, 0.2, 0.1]) - data.rx_position[i]
        rays[i] = np.vstack([rays[i], towards / np.linalg.norm(towards)])
    told = method_class("newrf")().precompute(replace(data, directions=rays), np.arange(len(data)))
    found, votes = told["virtual"].numpy(), told["votes"].numpy()
    nearest = np.linalg.norm(found[:, None] - sources[None], axis=-1)
    assert (nearest.min(0) < 0.02).all(), "every image is found"
    assert (nearest.min(1) < 0.02).all(), "and what is found is an image"
    assert (votes.sum(1) == len(sources)).all() and len(found) == len(sources)


def test_newrf_asks_the_neighbours_how_many_paths_there_are(tmp_path):
    """A query had as many as training receivers have on average."""
    data, fold, _ = room(40, directions=True)
    net = fitted(
        "newrf", data, fold, tmp_path, width=8, samples=8, max_steps=1, neighbours=3
    ).network
    votes = torch.zeros(6, 6)
    votes[:3, 0] = votes[3:, 1:] = votes[0, 1] = 1  # one of the first three sees another
    places = torch.eye(3)[:1] * torch.tensor([0.0, 0.1, 0.2, 9.0, 9.1, 9.2])[:, None]
    net.precomputed = {"places": places, "virtual": torch.rand(6, 3), "votes": votes}
    assert net.transmitters_and_likely(places[[1, 4]], False)[1].sum(1).tolist() == [1, 5]


def test_newrf_opaque_samples_give_no_nan(tmp_path):
    """An opacity that rounds to 1 left a transmittance of exp(-inf + inf)."""
    data, fold, _ = room(40, directions=True)
    method = fitted("newrf", data, fold, tmp_path, width=8, samples=8, max_steps=1)
    with torch.no_grad():
        last = [layer for layer in method.network.network if isinstance(layer, torch.nn.Linear)][-1]
        last.bias[2] = 200.0
    batch = data.batch(fold.train[:4])
    loss = method.network.loss(batch, torch.Generator().manual_seed(0))
    loss.backward()
    assert torch.isfinite(loss)
    assert all(
        torch.isfinite(p.grad).all() for p in method.network.parameters() if p.grad is not None
    )


@pytest.mark.slow
def test_newrf_predicts_where_no_direction_was_measured(tmp_path):
    data, fold, _ = room(80, directions=True)
    settings = {
        "width": 48,
        "depth": 3,
        "octaves": 3,
        "samples": 24,
        "max_steps": 250,
        "rate": 4e-3,
    }
    method = fitted("newrf", data, fold, tmp_path, **settings)
    where = data.batch(fold.test)
    plain = error(fitted("gp", data, fold, tmp_path), data, fold.test)
    assert error(method, data, fold.test) < 0.3 * min(plain, 1.0)
    moved = Pose(where.rx.position + 0.5, where.rx.rotation)
    assert not torch.allclose(
        method.predict(where).mean, method.predict(Query(where.tx, moved)).mean
    )


def test_kriging_knows_how_far_shadows_reach(tmp_path):
    data, fold = shadowed()
    decibels = 10 * np.log10(data.target)
    law = fit_variogram(data.moving, decibels)
    assert 0.5 < law.range / 2.0 < 2 and 0.5 < law.variance / 36 < 2
    method = fitted("kriging", data, fold, tmp_path)
    batch = data.batch(fold.test)
    said = method.predict(batch)
    miss = 10 * np.log10(said.mean.numpy()) - decibels[fold.test]
    known = 10 * np.log10(fitted("mean", data, fold, tmp_path).predict(batch).mean.numpy())
    assert (miss**2).mean() < 0.7 * ((known - decibels[fold.test]) ** 2).mean()
    sure = said.confidence.numpy()
    assert (miss[sure > np.median(sure)] ** 2).mean() < (miss[sure <= np.median(sure)] ** 2).mean()
    far = Pose(batch.rx.position[:1] + 1000.0, batch.rx.rotation[:1])
    assert method.predict(Query(batch.tx[:1], far)).confidence < 0.05

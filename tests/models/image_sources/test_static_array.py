"""A transmitter that moves before several antennas: all share the sources,
each has its own images.
"""

import logging
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from gains import fitted, phased
from scenes import error, fold_of

from gsparc.models.image_sources.backprojection import rough_gains, score_candidates
from gsparc.models.image_sources.clutter.residual import ClutterLikelihood, _nll
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.refine import refine_scene
from gsparc.models.image_sources.rows import rows_of_measurements
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene, spherical_waves
from gsparc.physics.mirror_planes import bisector, image_rotations, images, reflect
from gsparc.physics.waves import LIGHT
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

CARRIER = 2.4e9
CENTRE, SIZE = np.array([1.7, 0.4, 2.0]), (3.0, 2.5)
WALLS = ((1.0, None), (0.7, (0, 0.0)), (0.6, (1, 0.0)), (0.6, (0, SIZE[0])), (0.5, (1, SIZE[1])))


def _channels(places, antennas, tones):
    """Direct path and four walls: (S, A, K) of places (S, 3) and antennas (A, 3)."""
    total = 0
    for gain, mirror in WALLS:
        image = antennas.copy()
        if mirror is not None:
            image[:, mirror[0]] = 2 * mirror[1] - image[:, mirror[0]]
        far = np.linalg.norm(places[:, None] - image, axis=-1)[..., None]
        total = total + gain * np.exp(-2j * np.pi * tones * far / LIGHT) / far
    return total


def _uplink(count=100, antennas=4, tones=None, rotation=None, noise=1e-3, seed=0):
    """A transmitter at `count` places before a static array half a wavelength apart along its x
    axis.
    """
    rng = np.random.default_rng(seed)
    tones = np.array([CARRIER]) if tones is None else tones
    places = rng.uniform([0.2, 0.2, 0.6], [SIZE[0] - 0.2, SIZE[1] - 0.2, 1.6], (count, 3))
    array = np.c_[np.arange(antennas) * LIGHT / CARRIER / 2, np.zeros((antennas, 2))]
    rotation = np.eye(3) if rotation is None else rotation
    channels = _channels(places, CENTRE + array @ rotation.T, tones)
    power = noise * (np.abs(channels) ** 2).mean()
    channels = channels + np.sqrt(power / 2) * (rng.standard_normal((*channels.shape, 2)) @ [1, 1j])
    arrays = {
        "tx_position": places,
        "rx_position": CENTRE,
        "rx_rotation": rotation,
        "array_position": array,
        "csi": channels,
        "frequency_hz": tones,
    }
    data = from_arrays(arrays, {"name": "uplink"})
    return data, fold_of(data, seed=seed)


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    data, fold = _uplink()
    return fitted(data, fold, tmp_path_factory.mktemp("run"))[0], data, fold


@pytest.mark.slow
def test_four_antennas_at_a_hundred_places(four):
    method, data, fold = four
    missed = error(method, data, fold.test)
    assert missed < 0.02 and (method.factors == 1).all()
    true = [CENTRE]
    for _, (axis, wall) in WALLS[1:]:
        image = CENTRE.copy()
        image[axis] = 2 * wall - image[axis]
        true.append(image)
    found = (method.members[0].scene.sources + method.frame.middle).numpy() + data.site.origin
    assert np.linalg.norm(np.array(true)[:, None] - found, axis=-1).min(1).max() < 0.05


def test_orientation_of_first_and_second_order():
    """Mirrors in planes of any slant: the image of an antenna is that of the centre plus Q a."""
    draws = torch.Generator().manual_seed(0)
    planes = torch.randn(3, 4, generator=draws, dtype=torch.float64)
    centre, antenna = torch.randn(2, 3, generator=draws, dtype=torch.float64)
    sequences = [(), (0,), (2,), (0, 1), (2, 1)]
    turned = image_rotations(planes, sequences)
    torch.testing.assert_close(
        images(centre + antenna, planes, sequences),
        images(centre, planes, sequences) + turned @ antenna,
    )
    normal = planes[0, :3] / planes[0, :3].norm()
    householder = torch.eye(3, dtype=torch.float64) - 2 * torch.outer(normal, normal)
    torch.testing.assert_close(turned[1], householder)
    torch.testing.assert_close(torch.linalg.det(turned), torch.tensor([1.0, -1, -1, 1, 1]).double())
    halfway = bisector(centre, images(centre, planes, sequences)[1])
    torch.testing.assert_close(
        reflect(centre + antenna, halfway), images(centre + antenna, planes, sequences)[1]
    )


def _rows_and_scene():
    data, fold = _uplink(40)
    rows = rows_of_measurements(data, fold.train, 100, 0)
    static = torch.from_numpy(data.site.static_position)
    planes = torch.tensor([[1.0, 0, 0, -data.site.origin[0]]]).double()
    scene = SourceScene(static, planes, ((), (0,)), torch.zeros(2), -5.0)
    return rows, scene


def test_gradient_by_planes_and_position_is_that_of_the_likelihood():
    rows, scene = _rows_and_scene()
    assert len(rows) <= 100 and len(rows.element.unique()) == 4
    moved = replace(scene, planes=scene.planes + torch.tensor([0, 0, 0, 0.004]).double())
    before = GainPosterior(rows, moved).nll
    assert GainPosterior(rows, refine_scene(rows, moved, 10)).nll < before - 1


def test_quick_scores_of_an_array_are_those_without_a_covariance():
    rows, scene = _rows_and_scene()
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(1)).double() + 3
    spread = reflect(
        rows.static_ends(scene.transmitter)[:, None], bisector(scene.transmitter, points)
    )
    waves = spherical_waves(rows, spread)
    slow = (waves.mH @ rows.target).abs().square().sum(1) / waves.abs().square().sum(0)
    torch.testing.assert_close(rough_gains(rows, spread, rows.target), slow, rtol=1e-2, atol=1e-2)
    assert score_candidates(GainPosterior(rows, scene), spread)[0].shape == (300,)
    with pytest.raises(ValueError, match="images of each"):
        spherical_waves(rows, points)


@pytest.mark.slow
def test_antennas_with_phases_of_their_own(tmp_path):
    """Cables of unknown length: no source was found."""
    data, fold = _uplink(100)
    factors = np.array([1.0, 0.8 * np.exp(2.0j), 1.2 * np.exp(-1.0j), np.exp(0.5j)])
    turned = replace(data, target=(data.target * factors[:, None]).astype(np.complex64))
    method, report = fitted(turned, fold, tmp_path)
    assert error(method, turned, fold.test) < 0.02
    left = method.factors.numpy() * factors
    assert np.allclose(left, left[0], rtol=0.05)
    assert any("factors of the 4 antennas" in note for note in report.notes)


def test_antennas_of_unknown_places_are_outputs_of_their_own():
    data, fold = _uplink(30, antennas=2)
    rows = rows_of_measurements(
        replace(data, site=replace(data.site, array=None)), fold.train, 1000, 0
    )
    assert rows.target.shape == (len(fold.train), 2) and rows.array is None


def test_the_inner_matrix_of_hardly_any_noise_has_a_factor():
    """`I + C^T C` of whitened columns: 1e9 beside the 1 of two columns alike."""
    one = 1e3 * torch.randn(2000, 1, generator=torch.Generator().manual_seed(0))
    columns = torch.cat([one, one * (1 + 1e-7)], 1)
    single = columns.T @ columns + torch.eye(2)
    assert torch.linalg.cholesky_ex(single)[1] > 0
    assert torch.isfinite(_nll(columns, one[:, 0], 0.0))


def test_clutter_is_looked_for_without_noise():
    rows, scene = _rows_and_scene()
    silent = replace(scene, log_noise=-40.0, visibility=KernelVisibility(0.999, 5.0, 50.0))
    again = ClutterLikelihood(rows, phased(silent, torch.zeros(2), 0.15))
    assert np.isfinite(again.nll(torch.ones(2, len(rows)), silent.log_amplitude).item())


def test_an_interrupt_ends_all_searches(tmp_path, monkeypatch, caplog):
    data, fold = _uplink(100)
    caplog.set_level(logging.INFO)

    def interrupt(*unused, **named):
        time.sleep(0.1)
        raise KeyboardInterrupt

    monkeypatch.setattr("gsparc.models.image_sources.ensemble.wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        ImageSourceGP(searches=2, margin=8.0).fit(data, fold, FitContext(tmp_path))
    assert "search 1 of 2" not in caplog.text  # said at its end

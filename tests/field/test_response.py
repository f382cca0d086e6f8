"""Coherent terms of the splatted field: factored channels, carrier phase, splat then A; end to end."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from campaigns import channels as channel_file
from campaigns import compose
from contexts import short
from invented import invent
from known_arrays import array_site, spectra
from rooms import nmse, shoebox
from torch import Tensor

from gsparc.callbacks import ContributionPruning
from gsparc.data.campaigns.rfid import planar_array
from gsparc.data.load import load as load_data
from gsparc.data.splits import Fold
from gsparc.field.frozen import frozen_view
from gsparc.field.response import ArrayResponse, ChannelResponse, PathResponse
from gsparc.methods.registry import build
from gsparc.ops import Pose, SphereGrid, StalePlan
from gsparc.physics.array_response import normalised
from gsparc.simulate.shoebox import LIGHT

GRID = SphereGrid.hemisphere(8, 16)


def trained(data, fold, folder, *overrides: str, steps: int = 30):
    """`model=gsparc` with overrides, trained for a moment."""
    method = build(compose("logger=none", *overrides).model)
    context = short(folder, steps, 16, lambda: [ContributionPruning(interval=10)], validate_every=steps)
    return method, method.fit(data, fold, context)


# ---- factored channels ----
@pytest.mark.parametrize("tones", [2.4e9 + 1e6 * np.arange(7), 2.4e9 + 1e6 * np.array([0, 1, 2.5, 5])])
def test_channels_are_steering_times_gain_times_delay(tones):
    """Even combs by recurrence, uneven ones one by one; both are the sum written out."""
    lengths = torch.tensor([0.0, 3.0, 40.0])
    response = ChannelResponse(2, len(tones), torch.from_numpy(tones), lengths)
    with torch.no_grad():
        response.steering.normal_()
    gains = torch.randn(5, 3, dtype=torch.complex64)
    offset = torch.from_numpy(tones - tones[0])
    turns = torch.outer(lengths.double() / LIGHT, offset - offset.mean())
    comb = torch.exp(-2j * torch.pi * turns).to(torch.complex64)
    want = torch.einsum("bn,na,nk->bak", gains, torch.view_as_complex(response.steering), comb)
    torch.testing.assert_close(response(gains), want, atol=1e-4, rtol=1e-4)
    response(gains).abs().sum().backward()
    assert response.delays.grad.abs().sum() > 0 and response.steering.grad.abs().sum() > 0


def test_one_channel_learns_no_delay():
    response = ChannelResponse(1, 1, torch.tensor([1e9]), torch.ones(4))
    assert not response.delays.requires_grad
    gains = torch.randn(2, 4, dtype=torch.complex64)
    torch.testing.assert_close(response(gains)[:, 0, 0], gains.sum(1))


@pytest.mark.slow
def test_1664_channels_cost_no_more_than_twice_one(tmp_path):
    """64 antennas x 26 subcarriers through the whole model; the quicker of interleaved rounds."""
    data = load_data({"name": "own", "file": str(channel_file(tmp_path / "own.npz"))})
    calls = {}
    for name, shape in (("one", (1, 1)), ("many", (64, 26))):
        target = np.zeros((len(data), *shape), np.complex64)
        tones = 2.4e9 + 3e5 * np.arange(shape[1])
        wide = replace(data, target=target, site=replace(data.site, subcarriers_hz=tones, array=None))
        fold = Fold(np.arange(40), np.arange(40, 50), np.arange(50, 80))
        quiet = ["model.effects.phase=false", "model.effects.array=false", "model.refit=false"]
        method, _ = trained(wide, fold, tmp_path / name, *quiet, steps=1)
        calls[name] = (method, wide.batch(np.array([60])))
    times = {name: [] for name in calls}
    for _ in range(40):
        for name, (method, batch) in calls.items():
            begin = time.perf_counter()
            method.predict(batch.tx, batch.rx)
            times[name].append(time.perf_counter() - begin)
    many, one = (np.quantile(times[name], 0.2) for name in ("many", "one"))
    assert many <= 2 * one


# ---- carrier phase ----
def _responses(told, data, antennas):
    response = PathResponse(data.site, len(told.images.gain), antennas)
    means = torch.from_numpy(told.images.of(told.tx[0]) - data.site.origin)
    frequency = told.frequency_hz.mean() if data.site.carrier_hz is None else data.site.carrier_hz
    factor = LIGHT / frequency / (4 * np.pi) / data.site.target_scale
    return response, means, torch.from_numpy(told.images.gain * factor).to(torch.complex64)


@pytest.mark.parametrize("array", [None, np.array([[0.0, 0, 0], [0.06, 0, 0], [0, 0.06, 0]])])
def test_known_images_give_the_simulators_channels(array):
    """Amplitude, phase and delay over the band, at every element, from positions alone."""
    tones = 2.4e9 + 5e6 * np.arange(8)
    told, data, _ = shoebox(20, max_order=1, frequency_hz=tones, array=array, snr_db=200)
    batch = data.batch(np.arange(20))
    response, means, gains = _responses(told, data, data.target.shape[1])
    got = response(gains.expand(20, -1), means, batch.rx)
    torch.testing.assert_close(got, batch.target, atol=2e-4, rtol=1e-3)


def test_slopes_by_position_are_those_of_the_phase():
    told, data, _ = shoebox(6, max_order=1, snr_db=200)
    batch = data.batch(np.arange(6))
    response, means, gains = _responses(told, data, 1)
    off = torch.full(means.shape, 0.003, dtype=torch.float64)

    def loss(places: Tensor) -> Tensor:
        return (response(gains.expand(6, -1), places, batch.rx) - batch.target).abs().square().sum().double()

    places = (means + off).requires_grad_()
    (slope,) = torch.autograd.grad(loss(places), places)
    step = 1e-4 * slope / slope.norm()
    ahead, behind = loss(means + off + step), loss(means + off - step)
    assert float((ahead - behind) / 2e-4) == pytest.approx(float(slope.norm()), rel=0.02)


def _small(count=200, **more):
    return shoebox(count, size=(3.0, 2.5, 2.2), max_order=1, **more)


PHASE = ["model.effects.phase=splat", "model.effects.array=false", "model.refit=false"]


def test_back_projection_starts_where_the_sources_are_and_uniform_does_not(tmp_path):
    told, data, fold = _small()
    batch, error = data.batch(fold.test), {}
    for init in ("backprojection", "uniform"):
        method, report = trained(data, fold, tmp_path / init, *PHASE, f"model.field.init={init}")
        error[init] = nmse(method.predict(batch.tx, batch.rx).mean.numpy(), batch.target.numpy())
        assert report.seconds > 0 and method.effects == "phase (splat)"
        if init == "backprojection":
            true = told.images.of(told.tx[0])
            found = method.model.gaussians.means.detach().numpy() + data.site.origin
            assert np.linalg.norm(true[:, None] - found[None], axis=-1).min(1).max() < 0.2 * 0.125
            assert method.size() <= 20
    assert error["backprojection"] < 0.02 < 0.3 < error["uniform"]


def test_weak_sources_are_pruned_by_contribution(tmp_path):
    _, data, fold = _small(60)
    spoiled = ContributionPruning(interval=1, least_share=0.05)
    method = build(compose("logger=none", *PHASE, "model.field.init=uniform", "model.field.count=30").model)
    method.fit(data, fold, short(tmp_path, 4, 16, lambda: [spoiled]))
    assert 1 <= method.size() < 30
    batch = data.batch(fold.test[:3])
    assert method.predict(batch.tx, batch.rx).mean.shape == batch.target.shape


@pytest.mark.slow
def test_offsets_of_snapshots_are_looked_through(tmp_path):
    """Phase and timing of each snapshot unknown: the loss is blind to them, and the start estimates them."""
    tones = 2.4e9 + np.arange(4) * 20e6
    _, data, fold = _small(110, frequency_hz=tones, reflection=-0.5)
    rng = np.random.default_rng(0)
    delay = rng.uniform(-20e-9, 20e-9, (len(data), 1))
    turn = rng.uniform(-np.pi, np.pi, (len(data), 1)) - 2 * np.pi * delay * (tones - tones.mean())
    seen = replace(data, target=(data.target * np.exp(1j * turn)[:, None]).astype(np.complex64))
    method, _ = trained(seen, fold, tmp_path, *PHASE, "model.loss.snapshot=phase_timing")
    batch = data.batch(fold.test)
    got, want = method.predict(batch.tx, batch.rx).mean.numpy(), batch.target.numpy()
    scalar = (got.conj() * want).sum((1, 2)) / (np.abs(got) ** 2).sum((1, 2))
    assert nmse(got * scalar[:, None, None], want) < 0.06


# ---- splat, then A ----
def _array_response(how="max"):
    site = array_site(GRID, planar_array(2, 2), normalisation=how)
    return site, ArrayResponse(site, 0.0)


def test_spectra_are_the_beamformers():
    site, response = _array_response()
    h = torch.randn(3, 4, dtype=torch.complex64)
    want = normalised(spectra(site, h).flatten(1), "max").view(3, 8, 16)
    torch.testing.assert_close(response.spectra(h), want, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("how", ["max", "minmax", "power", "none"])
def test_slopes_from_a_spectrum_to_the_composited_field(how):
    _, response = _array_response(how)
    response = response.double()
    response.matrix = response.matrix.to(torch.complex128)
    z = torch.randn(2, 2, 8, 16, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(response, [z], fast_mode=True)


def test_slopes_end_to_end_through_composite():
    """From the published spectrum to where Gaussians are, how opaque, and what they emit."""
    model = _splatted()
    rx, tx = _pose(), torch.tensor([[1.3, 1.6, 1.0], [1.2, 1.5, 1.1]])
    wanted = torch.rand(2, 8, 16)

    def loss() -> Tensor:
        return (model(tx, rx).mean - wanted).square().sum()

    for parameter in (model.gaussians.means, model.gaussians.opacity_logits, model.emission.weight2):
        (slope,) = torch.autograd.grad(loss(), parameter)
        step = 2e-3 * slope / slope.norm()
        with torch.no_grad():
            kept = parameter.clone()
            parameter.add_(step)
            ahead = loss()
            parameter.copy_(kept).sub_(step)
            behind = loss()
            parameter.copy_(kept)
        assert float(ahead - behind) / 4e-3 == pytest.approx(float(slope.norm()), rel=0.1)


def _pose() -> Pose:
    site = array_site(GRID, planar_array(2, 2))
    return Pose(torch.from_numpy(site.static_position).float(), torch.from_numpy(site.rx_rotation).float())


def _splatted(hidden: int = 0):
    from gsparc.field.emission import EmissionSettings
    from gsparc.field.encoding import EncodingSettings
    from gsparc.field.gaussians import FieldSettings
    from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings
    from gsparc.field.response import ResponseSettings

    torch.manual_seed(0)
    settings = ModelSettings(
        field=FieldSettings(count=30, placement="sphere"),
        attenuation=AttenuationSettings(inverse_distance=bool(hidden)),
        emission=EmissionSettings(
            EncodingSettings("fourier"), hidden, "linear", init_scale=1.0, init_bias=0.0
        ),
        response=ResponseSettings(array=True),
    )
    return GaussianModel(settings, array_site(GRID, planar_array(2, 2)), _pose())


@pytest.mark.parametrize("hidden", [0, 4])
def test_the_small_matrix_says_what_compositing_says(hidden):
    model, tx = _splatted(hidden), torch.rand(5, 3)
    frozen = frozen_view(model, _pose())
    assert frozen.view.shape == (30, 4) and (frozen.weights is None) == bool(hidden)
    got = frozen.render(model, tx, _pose()).mean
    torch.testing.assert_close(got, model(tx, _pose()).mean.detach(), atol=1e-4, rtol=1e-3)
    model.gaussians.version += 1
    with pytest.raises(StalePlan, match="freeze again"):
        frozen.render(model, tx, _pose())


@pytest.mark.parametrize(
    ("kind", "effect", "message"),
    [("csi", "array", "array=splat is not possible"), ("spectrum", "phase", "phase=splat is not possible")],
)
def test_what_cannot_be_splatted_is_said(tmp_path, kind, effect, message):
    fold = Fold(np.arange(10), np.arange(10, 14), np.arange(14, 20))
    with pytest.raises(ValueError, match=message):
        trained(invent(kind, 20), fold, tmp_path, f"model.effects.{effect}=splat")


def test_back_projection_without_carrier_phase_is_refused(tmp_path):
    _, data, fold = _small(20)
    with pytest.raises(ValueError, match=r"needs model\.effects\.phase=splat"):
        trained(data, fold, tmp_path, "model.effects.phase=false", "model.field.init=backprojection")

"""From emissions to measurements: factored channels, splat then A; end to end."""

import numpy as np
import pytest
import torch
from known_arrays import array_site, spectra
from torch import Tensor

from gsparc.datasets.rfid import planar_array
from gsparc.field.frozen import freeze_view, gaussian_vectors
from gsparc.field.response import ArrayResponse, ChannelResponse
from gsparc.ops import Pose, SphereGrid, StalePlan
from gsparc.physics.array_response import normalise_spectrum
from gsparc.simulate.shoebox import LIGHT

GRID = SphereGrid.hemisphere(8, 16)


# ---- factored channels ----
@pytest.mark.parametrize(
    "tones", [2.4e9 + 1e6 * np.arange(7), 2.4e9 + 1e6 * np.array([0, 1, 2.5, 5])]
)
def test_channels_are_steering_times_gain_times_delay(tones):
    """Even combs and uneven ones are the sum written out."""
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


def test_products_of_many_rows_were_stored_for_each_antenna(monkeypatch):
    """512 rows of 2,000 sources at 64 antennas: 3 s and 1 GB,
    and .03 to .9 s with the rows last.
    """
    stored, product = [], torch.einsum
    monkeypatch.setattr(
        torch, "einsum", lambda how, *parts: stored.append(parts) or product(how, *parts)
    )
    for rows in (1, 64):
        ChannelResponse(8, 16, None, torch.ones(3))(torch.randn(rows, 3, dtype=torch.complex64))
        assert stored[-1][2].numel() == max(one.numel() for one in stored[-1])


def test_one_channel_learns_no_delay():
    response = ChannelResponse(1, 1, torch.tensor([1e9]), torch.ones(4))
    assert not response.delays.requires_grad
    gains = torch.randn(2, 4, dtype=torch.complex64)
    torch.testing.assert_close(response(gains)[:, 0, 0], gains.sum(1))


# ---- splat, then A ----
def _array_response(how="max"):
    site = array_site(GRID, planar_array(2, 2), normalisation=how)
    return site, ArrayResponse(site, 0.0)


def test_spectra_are_the_beamformers():
    site, response = _array_response()
    h = torch.randn(3, 4, dtype=torch.complex64)
    want = normalise_spectrum(spectra(site, h).flatten(1), "max").view(3, 8, 16)
    torch.testing.assert_close(response.spectra(h), want, atol=1e-4, rtol=1e-3)


def test_slopes_end_to_end_through_composite():
    """From the published spectrum to where Gaussians are, how opaque, and what they emit."""
    model = _splatted()
    rx, tx = _pose(), torch.tensor([[1.3, 1.6, 1.0], [1.2, 1.5, 1.1]])
    wanted = torch.rand(2, 8, 16)

    def loss() -> Tensor:
        return (model(tx, rx).mean - wanted).square().sum()

    for parameter in (
        model.gaussians.means,
        model.gaussians.opacity_logits,
        model.emission.weight2,
    ):
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
    return Pose(
        torch.from_numpy(site.static_position).float(), torch.from_numpy(site.rx_rotation).float()
    )


def _splatted(hidden: int = 0, count: int = 30):
    from gsparc.field.emission import EmissionSettings
    from gsparc.field.encoding import EncodingSettings
    from gsparc.field.gaussians import FieldSettings
    from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings
    from gsparc.field.response import ResponseSettings

    torch.manual_seed(0)
    settings = ModelSettings(
        field=FieldSettings(count=count, placement="sphere"),
        attenuation=AttenuationSettings(inverse_distance=bool(hidden)),
        emission=EmissionSettings(
            EncodingSettings("fourier"), hidden, "linear", init_scale=1.0, init_bias=0.0
        ),
        response=ResponseSettings(array=True),
    )
    return GaussianModel(settings, array_site(GRID, planar_array(2, 2)), _pose())


def test_what_the_array_sees_of_each_gaussian_is_what_it_measures_of_its_image():
    """Freezing rendered every Gaussian by itself: 106 s at 62,000 of them, 0.3 s by gradients."""
    model = _splatted()
    plan, seen = model.freeze(_pose()), gaussian_vectors(model, _pose())
    images = plan.render(torch.eye(30), int(model.gaussians.version))
    alone = model.response.array_vectors(torch.stack([images, torch.zeros_like(images)], 1))
    torch.testing.assert_close(seen, alone, atol=1e-6 * float(alone.abs().max()), rtol=1e-4)
    with torch.inference_mode():  # as Trainer.test asks
        torch.testing.assert_close(gaussian_vectors(model, _pose()), seen)


@pytest.mark.parametrize("hidden", [0, 4])
def test_the_small_matrix_says_what_compositing_says(hidden):
    model, tx = _splatted(hidden), torch.rand(5, 3)
    frozen = freeze_view(model, _pose())
    assert frozen.view.shape == (30, 4) and (frozen.weights is None) == bool(hidden)
    got = frozen.render(model, tx, _pose()).mean
    torch.testing.assert_close(got, model(tx, _pose()).mean.detach(), atol=1e-4, rtol=1e-3)
    model.gaussians.version += 1
    with pytest.raises(StalePlan, match="freeze again"):
        frozen.render(model, tx, _pose())

import numpy as np
import pytest
import torch

from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.frozen import freeze_view
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings
from gsparc.field.response import ResponseSettings
from gsparc.ops import Pose, StalePlan

RAW = EncodingSettings("raw")
LINEAR = EmissionSettings(RAW, hidden=3, activation="linear", init_bias=0.0)
INVERSE = AttenuationSettings(inverse_distance=True)
RECEIVER = Pose.identity(torch.tensor([4.0, 0.0, 0.0]))


def model(data, count: int = 20, **more) -> GaussianModel:
    torch.manual_seed(0)
    moving = data.site.static_end == "tx"
    settings = ModelSettings(
        **{
            "field": FieldSettings(count=count, placement="uniform", opacity=0.5),
            "emission": LINEAR,
            "attenuation": INVERSE,
            **more,
        }
    )
    transmitter = torch.from_numpy(data.tx[0]).float() if moving else None
    return GaussianModel(settings, data.site, None if moving else RECEIVER, transmitter)


@pytest.mark.parametrize("static_end", ["rx", "tx"])
@pytest.mark.parametrize(
    ("kind", "shape"), [("spectrum", (12, 24)), ("csi", (1, 1)), ("rssi", (1,))]
)
def test_a_prediction_has_the_shape_of_a_target(campaign, kind, shape, static_end):
    data = campaign(kind, static_end=static_end)
    batch = data.batch(np.arange(5))
    rendered = model(data)(batch.tx, batch.rx)
    assert rendered.mean.shape == (5, *shape) and rendered.mean.is_complex() == (kind == "csi")
    assert (rendered.raster is None) == (kind != "spectrum")
    rendered.mean.abs().sum().backward()


def test_antennas_and_subcarriers_are_factored(campaign):
    data = campaign("csi")
    batch = data.batch(np.arange(5))
    wide = GaussianModel(model(data).settings, data.site, RECEIVER, shape=(4, 3))
    assert wide(batch.tx, batch.rx).mean.shape == (5, 4, 3)
    assert wide.emission.channels == 2  # one complex gain, however many channels


def test_signed_channels_refuse_an_activation_of_powers(campaign):
    with pytest.raises(ValueError, match="channels are signed, choose linear"):
        model(campaign("csi"), emission=EmissionSettings(RAW, activation="sigmoid", init_bias=0.0))


def test_attenuation_is_gain_over_distance_and_can_be_off(campaign):
    data = campaign("spectrum")
    batch = data.batch(np.arange(4))
    on = model(
        data, attenuation=AttenuationSettings(inverse_distance=True, gain=3.0, d_ref=2.0, d_min=0.1)
    )
    off = model(data, attenuation=AttenuationSettings(inverse_distance=False))
    apart = (batch.tx[:, None] - on.gaussians.means).square().sum(-1).add(0.01).sqrt() / 2.0
    assert torch.allclose(on.relative_distances(batch.tx), apart, atol=1e-6)
    plain = off.emissions(batch.tx, batch.rx)
    assert off.attenuation(apart) is None
    assert torch.allclose(
        on.emissions(batch.tx, batch.rx), plain * (3.0 / apart)[..., None], rtol=1e-4
    )


def test_the_reference_distance_is_from_the_still_end_to_the_moving_box(campaign):
    assert model(campaign("spectrum")).d_ref == pytest.approx(4.0)
    assert model(campaign("spectrum", static_end="tx")).d_ref == pytest.approx(4.0)
    assert model(campaign("spectrum"), attenuation=AttenuationSettings(d_ref=7.0)).d_ref == 7.0


def test_only_the_gaussians_that_a_static_receiver_sees_emit(campaign):
    data = campaign("spectrum")
    batch = data.batch(np.arange(6))
    field = model(data, field=FieldSettings(count=60, placement="uniform", margin=4.0))
    want = field(batch.tx, batch.rx)
    view = freeze_view(field, batch.rx)
    seen = int(want.raster.visible.sum())
    assert 0 < seen < 60 and len(view.visible.gaussians) == seen
    for some in (batch.tx, batch.tx[:1]):
        assert torch.allclose(
            view.render(field, some, batch.rx).mean, want.mean[: len(some)], atol=1e-5
        )
    assert len(field.gaussians) == 60  # the field itself is left as it was
    with torch.no_grad():
        field.gaussians.version += 1
    with pytest.raises(StalePlan, match="freeze again"):
        view.render(field, batch.tx, batch.rx)


def test_poses_of_a_batch_are_seen_each_for_itself(campaign):
    data = campaign("spectrum", static_end="tx")
    field, batch = model(data), data.batch(np.arange(4))
    together = field(batch.tx, batch.rx).mean
    for i in range(4):
        alone = field(batch.tx[i : i + 1], batch.rx[i : i + 1]).mean
        assert torch.allclose(together[i], alone[0], atol=1e-6)


def mean_of_images(data, shape=(1, 1), **settings) -> GaussianModel:
    torch.manual_seed(0)
    emission = EmissionSettings(
        RAW, hidden=3, activation="signed_sigmoid", log_distance=True, init_bias=0.0
    )
    field = FieldSettings(count=20, placement="uniform", opacity=0.5)
    whole = ModelSettings(field, emission, INVERSE, response=ResponseSettings(**settings))
    transmitter = torch.from_numpy(data.tx[0]).float()
    return GaussianModel(whole, data.site, None, transmitter, shape=shape)


def test_channels_are_means_over_an_image_of_emissions(campaign):
    """Equation 2 of the paper, by its weights: the image is not rendered."""
    data = campaign("csi", static_end="tx")
    batch = data.batch(np.arange(3))
    field = mean_of_images(data, (2, 3), channel="mean")
    image = field.rasterize(field.emissions(batch.tx, batch.rx), batch.rx).image.mean((-2, -1))
    expected = torch.view_as_complex(image.view(3, 2, 3, 2))
    torch.testing.assert_close(field(batch.tx, batch.rx).mean, expected, rtol=1e-3, atol=1e-5)


def test_densification_sees_what_a_mean_asks_of_footprints(campaign):
    data = campaign("csi", static_end="tx")
    batch = data.batch(np.arange(3))
    field = mean_of_images(data, (1, 2), channel="mean")
    rendered = field(batch.tx, batch.rx)
    (rendered.mean - 1).abs().square().sum().backward()
    raster = field.raster_of_weights(rendered, batch.rx)
    whole = field.rasterize(field.emissions(batch.tx, batch.rx).detach(), batch.rx)
    mean = torch.view_as_complex(whole.image.mean((-2, -1)).view(3, 1, 2, 2))
    (mean - 1).abs().square().sum().backward()
    torch.testing.assert_close(raster.means2d.grad, whole.means2d.grad, rtol=1e-2, atol=1e-6)
    assert raster.means2d.grad.abs().max() > 1e-4


def test_a_spectrum_is_the_modulus_or_the_real_part_of_a_complex_image(campaign):
    data = campaign("spectrum", static_end="tx")
    batch = data.batch(np.arange(3))
    modulus, real = (mean_of_images(data, image=part) for part in ("modulus", "real"))
    image = modulus.rasterize(modulus.emissions(batch.tx, batch.rx), batch.rx).image
    torch.testing.assert_close(modulus(batch.tx, batch.rx).mean, image.norm(dim=1))
    torch.testing.assert_close(real(batch.tx, batch.rx).mean, image[:, 0])
    dark = modulus.to_spectra(torch.zeros(1, 2, 4, 4, requires_grad=True))
    dark.sum().backward()
    assert dark.max() < 1e-9

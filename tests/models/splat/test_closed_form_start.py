import dataclasses

import numpy as np
import pytest
import torch

from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings
from gsparc.models.splat.closed_form_start import learn_prior, learn_process, solve_emissions
from gsparc.ops import Pose

KERNEL = EmissionSettings(EncodingSettings("kernel"), activation="linear", init_bias=0.0)
RECEIVER = Pose.identity(torch.tensor([4.0, 0.0, 0.0]))
ROWS = np.arange(40)


def starting(data, emission=KERNEL, count: int = 150, on: bool = False) -> tuple:
    """A model after its start, and what the start left out."""
    torch.manual_seed(0)
    process = learn_process(data, ROWS, 1024, 0)
    settings = ModelSettings(
        field=FieldSettings(count=count, placement="sphere"),
        emission=emission,
        attenuation=AttenuationSettings(inverse_distance=on),
    )
    model = GaussianModel(settings, data.site, RECEIVER, prior=process.prior)
    return model, solve_emissions(model, data, ROWS, RECEIVER, process)


def started(data, *given, **more) -> GaussianModel:
    return starting(data, *given, **more)[0]


def error(model, data, rows) -> float:
    batch = data.batch(rows)
    with torch.no_grad():
        return float((model(batch.tx, batch.rx).mean - batch.target).square().mean())


def spread(data) -> float:
    images = data.targets(np.arange(len(data)))
    return float((images - images.mean(0)).square().mean())


@pytest.fixture(scope="module")
def smooth(campaign):
    """Images that are smooth in both direction and position."""
    data = campaign("spectrum", rows=48)
    from scipy.ndimage import gaussian_filter

    images = data.target.astype(np.float32) / 255
    images = np.stack([gaussian_filter(image, 3, mode="nearest") for image in images])
    images = 0.1 + 0.8 * (images - images.min()) / np.ptp(images)
    return dataclasses.replace(data, target=images.astype(np.float32))


@pytest.mark.parametrize("on", [False, True])
def test_the_start_explains_training_and_unseen_rows(smooth, on):
    model = started(smooth, on=on)
    assert error(model, smooth, ROWS) < 0.15 * spread(smooth)
    assert error(model, smooth, np.arange(40, 48)) < 0.5 * spread(smooth)


def test_a_network_with_hidden_units_has_no_closed_form(smooth):
    with pytest.raises(ValueError, match=r"or model\.emission\.hidden=0"):
        started(smooth, emission=dataclasses.replace(KERNEL, hidden=4))


def test_anchors_are_capped_and_drawn_by_seed(smooth):
    few = [learn_prior(smooth, ROWS, 10, seed).anchors for seed in (0, 0, 1)]
    assert len(few[0]) == 10 and torch.equal(few[0], few[1]) and not torch.equal(few[0], few[2])


def test_holes_of_masked_spectra_are_filled_not_learned(smooth):
    mask = np.ones(smooth.target.shape, bool)
    mask[:, :4] = np.random.default_rng(0).uniform(size=(len(mask), 4, 24)) < 0.8
    holes = np.where(mask, smooth.target, np.float32(0))
    model = started(dataclasses.replace(smooth, target=holes, mask=mask))
    assert error(model, smooth, ROWS) < 0.2 * spread(smooth)
    naive = started(dataclasses.replace(smooth, target=holes))
    assert error(naive, smooth, ROWS) > 2 * error(model, smooth, ROWS)

"""At the transmitter: 1 / d and log d blow up where a Gaussian meets it.

Remedy: d = sqrt(|x - mu|^2 + d_min^2) / d_ref. Shown: finite at d = 0, forward and backward, with
no pull on the Gaussian there; far away the slope of the plain law within (d_min / d)^2.
"""

import pytest
import torch

from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings
from gsparc.ops import Pose

RECEIVER = Pose.identity(torch.tensor([4.0, 0.0, 0.0]))
D_MIN, D_REF = 0.05, 2.0


def model(campaign, activation: str) -> GaussianModel:
    torch.manual_seed(0)
    emission = EmissionSettings(
        EncodingSettings("raw"),
        hidden=2,
        activation=activation,
        log_distance=activation == "sigmoid",
        init_bias=0.0,
    )
    attenuation = AttenuationSettings(inverse_distance=True, d_min=D_MIN, d_ref=D_REF, gain=1.0)
    settings = ModelSettings(FieldSettings(count=1, placement="uniform"), emission, attenuation)
    return GaussianModel(settings, campaign("spectrum").site, RECEIVER)


@pytest.mark.parametrize("activation", ["sigmoid", "linear"])
def test_finite_there_with_no_pull(campaign, activation):
    field = model(campaign, activation)
    tx = field.gaussians.means.detach().clone()
    features = field.emissions(tx, RECEIVER)
    features.sum().backward()
    assert torch.isfinite(features).all()
    assert float(field.relative_distances(tx).detach()) == pytest.approx(D_MIN / D_REF)
    assert (field.gaussians.means.grad == 0).all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in field.parameters())


def test_no_jump_on_the_way_through(campaign):
    field = model(campaign, "sigmoid")
    steps = torch.linspace(-0.2, 0.2, 401)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    seen = field.emissions(field.gaussians.means.detach() + steps, RECEIVER).detach()[:, 0, 0]
    assert seen.diff().abs().max() < 0.05 * seen.max()


@pytest.mark.parametrize("far", [1.0, 10.0, 1000.0])
def test_the_right_slope_far_away(campaign, far):
    field = model(campaign, "linear")
    tx = (field.gaussians.means.detach() + torch.tensor([[far, 0.0, 0.0]])).requires_grad_()
    weakened = field.attenuation(field.relative_distances(tx))
    (slope,) = torch.autograd.grad(weakened.sum(), tx)
    assert float(weakened.detach()) == pytest.approx(D_REF / far, rel=2 * (D_MIN / far) ** 2 + 1e-5)
    assert float(slope[0, 0]) == pytest.approx(-D_REF / far**2, rel=2 * (D_MIN / far) ** 2 + 1e-4)

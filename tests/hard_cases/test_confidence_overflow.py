"""Confidence overflow: exp(g) is infinite beyond 88;
clipping it after gives 0 * inf = NaN in the gradient.

Remedy: g is clamped first (its gradient beyond the clamp is 0), log C is softplus(g), targets have
unit power. Shown: g from -1e4 to 1e4, finite loss and gradient, in float32 and with a network in
bfloat16. Tolerance against float64 inside the clamp: 1e-6 relative to 1 + C.
"""

import pytest
import torch

from gsparc.field.confidence import Confidence, ConfidenceSettings, weighted_loss
from gsparc.field.encoding import EncodingSettings, PositionEncoding

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
G = [-1e4, -100.0, -88.8, -10.0, -1.0, 0.0, 1.0, 10.0, 88.8, 100.0, 1e4]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("g", G)
def test_finite_whatever_the_network_says(g, dtype):
    sure = Confidence(ConfidenceSettings(), PositionEncoding(EncodingSettings("raw"), BOX))
    with torch.no_grad():
        for parameter in sure.network.parameters():
            parameter.zero_()
        sure.network[2].bias.fill_(g)
    task = torch.tensor([0.0, 0.3, 10.0], requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        exponent = sure.exponent(torch.rand(3, 3))
        loss = weighted_loss(task, exponent, 0.3)
    assert exponent.dtype == torch.float32  # half precision would round 1 + exp(-8) to 1
    loss.sum().backward()
    assert loss.isfinite().all() and task.grad.isfinite().all()
    slope = sure.network[2].bias.grad
    assert slope.isfinite().all()
    assert abs(g) < 10.1 or slope == 0  # beyond the clamp nothing pulls


@pytest.mark.parametrize("g", [-10.0, -3.0, 0.0, 3.0, 10.0])
def test_right_inside_the_clamp(g):
    loss = torch.tensor([0.0, 0.3, 10.0])
    got = weighted_loss(loss, torch.full((3,), g), 0.3).double()
    c = 1 + torch.full((3,), g, dtype=torch.float64).exp()
    assert torch.allclose(
        got, c * loss.double() - 0.3 * c.log(), atol=float(1e-6 * (1 + c[0]) * 10)
    )

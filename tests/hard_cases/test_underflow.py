"""Underflow: in float32 the transmittance reaches 0, or a denormal that is not quite 0.

Remedy: one stopping rule, T before a layer >= cutoff.transmittance, the same in both passes
(csrc/forward.h). Shown: gradients of everything behind are exactly 0, not small.
"""

import pytest
import torch
from rasters import PROJECTIONS, Scene, assert_equals_float64, one, origin, render

from gsparc.ops import Cutoff, SphereGrid, make_plan, mean_weights

GRID = SphereGrid(5, 5, -0.02, -0.02, 0.01, 0.01)


def tunnel(n: int = 60) -> Scene:
    along = torch.linspace(1, 5, n).double()
    return Scene(
        means=torch.stack([along, 0 * along, 0 * along], 1),
        quats=torch.tensor([[0.9, 0.1, 0.2, 0.3]]).double().repeat(n, 1),
        scales=along[:, None] * torch.tensor([[0.4, 0.5, 0.6]]).double(),
        opacities=torch.full((n,), 0.97).double(),
        features=torch.ones(1, n, 1).double(),
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_lies_behind_gets_exactly_zero(backend, dtype):
    got = render(tunnel().to(dtype), origin(), GRID, backend)
    for name in ("d_means", "d_quats", "d_scales", "d_opacities"):
        assert (got[name][4:] == 0).all() and (got[name][0] != 0).any(), name
    assert (got["d_features"][:, 4:] == 0).all() and (got["transmittance"] > 0).all()


@PROJECTIONS
def test_equals_float64(backend, projection):
    assert_equals_float64(tunnel(), origin(), GRID, backend, projection=projection)


@pytest.mark.parametrize("opacity", [1e-44, 1e-38, 1e-31, 1e-20, 1e-3])
def test_share_of_the_faintest_has_no_slope_that_overflows(backend, opacity):
    """1 / sum(alpha) is infinite in float32, and 0 times it was NaN:
    the share keeps its value only.
    """
    model = [
        leaf.requires_grad_()
        for leaf in one([1.0, 0.0, 0.0], opacity=opacity).to(torch.float32).model
    ]
    plan = make_plan(*model, origin(), GRID, cutoff=Cutoff(1e-3, relative=True), backend=backend)
    share = mean_weights(plan, *model).share
    share.sum().backward()
    assert abs(share.item() - 1) < 1e-5
    assert all(leaf.grad.isfinite().all() for leaf in model)

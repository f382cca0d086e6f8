"""Underflow: in float32 the transmittance reaches 0, or a denormal that is not quite 0.

Remedy: one stopping rule, T before a layer >= cutoff.transmittance, the same in both passes (csrc/forward.h).
Shown: gradients of everything behind are exactly 0, not small.
"""

import pytest
import torch
from rasters import Scene, assert_equals_float64, origin, render

from gsparc.ops import SphereGrid

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


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
def test_equals_float64(backend, projection):
    assert_equals_float64(tunnel(), origin(), GRID, backend, projection=projection)


def test_without_a_stopping_rule_it_breaks():
    """Naive: the product of all layers is a denormal or 0, whose logarithm or inverse is inf."""
    left = torch.prod(torch.full((60,), 0.03))
    assert left == 0 and not torch.isfinite(1 / left)

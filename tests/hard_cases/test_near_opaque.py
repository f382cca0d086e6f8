"""Near-opaque: a backward pass that recovers the transmittance by dividing by 1 - alpha blows up.

Remedy: alpha is clamped at 0.99 in both passes, with zero gradient when clamped; the backward pass
runs front to back with the forward's own recurrence (csrc/backward.h). Shown: 10,000 layers,
finite, equal to float64 within 1e-9 in float64 and 1e-4 in float32.
"""

import math

import pytest
import torch
from rasters import Scene, assert_equals_float64, origin

from gsparc.ops import Cutoff, SphereGrid

GRID = SphereGrid(3, 4, 0.1, -0.2, 0.1, 0.1)


def wall(opacity: float, n: int = 10_000) -> Scene:
    draw = torch.Generator().manual_seed(4)
    means = torch.cat(
        [torch.linspace(2, 8, n)[:, None], 0.3 * torch.randn(n, 2, generator=draw)], 1
    )
    # Nearest, at a pixel's centre: it is clamped
    means[0] = torch.tensor([1.5, 0.0, 1.5 * math.tan(0.1)])
    return Scene(
        means=means.double(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).double().repeat(n, 1),
        scales=torch.full((n, 3), 0.5).double(),
        opacities=torch.full((n,), opacity).float().double(),
        features=torch.randn(1, n, 1, generator=draw).double(),
    )


@pytest.mark.parametrize("opacity", [1.0, 0.985, 0.01])
def test_many_layers(backend, opacity):
    want = assert_equals_float64(wall(opacity), origin(), GRID, backend, compensate=False)
    assert want["image"].abs().max() > 0.03


def test_no_stopping_rule_is_finite_too(backend):
    assert_equals_float64(wall(1.0, n=500), origin(), GRID, backend, cutoff=Cutoff(1 / 255, 0.0))

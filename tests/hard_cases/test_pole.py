"""Pole: the azimuth Jacobian diverges at the zenith, and asin has infinite slope there.

Remedy: `tangent` evaluates the footprint on the plane at the Gaussian's own direction, whose frame
is carried along by parallel transport in the backward pass (csrc/footprint.h); `equirect` bounds 1
/ cos(elevation) by 1 / sqrt(cos^2 + step^2) and is inexact there. Shown: a Gaussian carried through
the zenith keeps its energy, within 2 % (a sum over a grid whose cells shrink to nothing there),
and makes no jump.
"""

import math
from itertools import pairwise

import pytest
import torch
from rasters import PROJECTIONS, assert_equals_float64, one, origin, render

from gsparc.ops import SphereGrid

GRID = SphereGrid.full_sphere(90, 180)
TOUR = torch.linspace(0.3, math.pi - 0.3, 41).tolist()


def on_meridian(angle: float):
    return one([math.cos(angle), 0.0, math.sin(angle)], sigma=0.3, opacity=0.5)


def test_energy_is_kept_through_the_zenith(backend):
    weight = GRID.solid_angles()
    energy = [
        float((render(on_meridian(a), origin(), GRID, backend)["image"][0, 0] * weight).sum())
        for a in TOUR
    ]
    assert max(energy) / min(energy) < 1.02


def test_no_jump_at_the_zenith(backend):
    steps = [math.pi / 2 + k * 1e-4 for k in (-2, -1, 0, 1, 2)]
    images = [render(on_meridian(a), origin(), GRID, backend)["image"] for a in steps]
    moves = [float((a - b).abs().max()) for a, b in pairwise(images)]
    assert max(moves) < 2e-3 and max(moves) < 1.5 * min(moves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@PROJECTIONS
def test_finite_exactly_at_the_poles(backend, dtype, projection):
    for z in (1.0, -1.0):
        scene = one([0.0, 0.0, z], sigma=0.3).to(dtype)
        got = render(scene, origin(), GRID, backend, projection=projection)
        assert all(torch.isfinite(value).all() for value in got.values())
        assert got["image"].max() > 0.5


@PROJECTIONS
@pytest.mark.parametrize("away", [0.0, 1e-6, 1e-3, 0.1])
def test_equals_float64(backend, projection, away):
    scene = (
        on_meridian(math.pi / 2 - away) if away else one([0.0, 0.0, 1.0], sigma=0.3, opacity=0.5)
    )
    assert_equals_float64(scene, origin(), GRID, backend, projection=projection)


def test_tangent_gradient_at_the_zenith_is_the_slope(backend):
    """Central differences across the pole, where azimuth jumps by half a turn."""
    noise = torch.randn(
        1, 1, 90, 180, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )

    def loss(x: float) -> float:
        scene = one([x, 0.0, 4.0], distance=math.hypot(x, 4.0), sigma=0.3)
        return float((render(scene, origin(), GRID, backend, low_pass=0.3)["image"] * noise).sum())

    got = render(
        one([0.0, 0.0, 1.0], sigma=0.3), origin(), GRID, backend, upstream=noise, behind=False
    )
    slope = (loss(1e-5) - loss(-1e-5)) / 2e-5
    assert abs(float(got["d_means"][0, 0]) - slope) < 1e-4 * (1 + abs(slope))

"""At the receiver: r -> 0 divides by zero, and a Gaussian around the receiver has no direction.

Remedy: absent for r <= near, fading in smoothly up to 2 near (csrc/footprint.h, reference.py).
Shown: finite everywhere, gradients exactly zero when absent, no jump at either end: opacity is C1
in r, so a step of 1e-6 changes the image by less than 1e-3.
"""

from itertools import pairwise

import pytest
import torch
from rasters import assert_equals_float64, one, origin, render

from gsparc.ops import SphereGrid

GRID = SphereGrid.full_sphere(20, 40)
NEAR = 0.05


def at(distance: float):
    return one([0.3, 0.5, 0.4], distance=distance, sigma=0.2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("distance", [0.0, 1e-30, 1e-6, 0.01, NEAR * 0.999])
def test_absent_and_without_gradient(backend, dtype, distance):
    got = render(at(distance).to(dtype), origin(), GRID, backend, near=NEAR)
    assert (
        not got["visible"].any() and (got["image"] == 0).all() and (got["transmittance"] == 1).all()
    )
    for name in ("d_means", "d_quats", "d_scales", "d_opacities", "d_features", "d_means2d"):
        assert (got[name] == 0).all(), name


def test_fades_in_without_a_jump(backend):
    for edge in (NEAR, 2 * NEAR):
        a, b = (
            render(at(edge + s), origin(), GRID, backend, near=NEAR)["image"] for s in (-1e-6, 1e-6)
        )
        assert (a - b).abs().max() < 1e-3
    images = [
        render(at(NEAR * k / 10), origin(), GRID, backend, near=NEAR)["image"].max()
        for k in range(10, 21)
    ]
    assert all(a <= b + 1e-9 for a, b in pairwise(images)) and images[-1] > 0.5


@pytest.mark.parametrize("distance", [1.01 * NEAR, 1.5 * NEAR, 2 * NEAR, 0.2])
def test_equals_float64_while_it_fades_in(backend, distance):
    assert_equals_float64(at(distance), origin(), GRID, backend, near=NEAR)

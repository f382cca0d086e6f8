"""Needle, pancake: k11 k22 - k12^2 cancels to a negative number in float32.

Remedy: the determinant is a sum of squares of cofactors, |cof(M)^T n|^2 + low-pass terms, and the
quadratic form is completed to squares (csrc/footprint.h). Shown: aspect ratios up to 1e6 in float32
agree with float64. Tolerance 2e-3 on the image:
directions rounded to float32 move a needle 0.55 px thin by up to 1e-4 of that.
"""

import pytest
import torch
from rasters import PROJECTIONS, Scene, assert_equals_float64, origin, render

from gsparc.ops import SphereGrid

GRID = SphereGrid.full_sphere(60, 120)


def extreme(kind: str, aspect: float) -> Scene:
    draw = torch.Generator().manual_seed(8)
    n = 24
    means = torch.randn(n, 3, generator=draw).double()
    long, thin = 0.5, 0.5 / aspect
    sizes = {"needle": (long, thin, thin), "pancake": (long, long, thin)}[kind]
    return (
        Scene(
            means=torch.linspace(3, 5, n)[:, None] * means / means.norm(dim=1, keepdim=True),
            quats=torch.randn(n, 4, generator=draw).double(),
            scales=torch.tensor([sizes]).double().repeat(n, 1),
            opacities=torch.full((n,), 0.6, dtype=torch.float64),
            features=torch.randn(1, n, 1, generator=draw).double(),
        )
        .to(torch.float32)
        .to(torch.float64)
    )


@PROJECTIONS
@pytest.mark.parametrize("kind", ["needle", "pancake"])
@pytest.mark.parametrize("aspect", [1e2, 1e4, 1e6])
def test_float32_equals_float64(backend, projection, kind, aspect):
    scene = extreme(kind, aspect)
    tolerances = {torch.float32: 2e-3, torch.float64: 1e-9}
    assert_equals_float64(scene, origin(), GRID, backend, tolerances, projection=projection)


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_flat_and_empty_gaussians_are_harmless(backend, low_pass):
    scene = extreme("pancake", 1e6)
    scene.scales[:8, 2] = 0.0
    scene.scales[8:16] = 0.0
    got = render(scene.to(torch.float32), origin(), GRID, backend, low_pass=low_pass)
    assert all(torch.isfinite(value).all() for value in got.values())


def test_a_speck_without_low_pass_has_no_slope_that_overflows(backend):
    """A footprint of 1e-14 px^2: found in the reference, whose float32 gradient was NaN."""
    scene = extreme("needle", 1.0)
    scene.scales[:] = 1e-7
    got = render(scene.to(torch.float32), origin(), GRID, backend, low_pass=0.0, compensate=False)
    assert all(torch.isfinite(value).all() for value in got.values())

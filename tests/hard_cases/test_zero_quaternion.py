"""Zero quaternion: normalising divides by zero,
and squares of 1e-30 or 1e20 are no float32 numbers.

Remedy: up to 1e-18 it means no rotation and has no gradient; others are divided by their longest
component first (csrc/footprint.h, reference.py). Tolerance: none for zero;
1e-4 in float32 for 1e-12 to 1e20.
"""

import pytest
import torch
from rasters import assert_equals_float64, origin, random_scene, render

from gsparc.ops import SphereGrid

GRID = SphereGrid.full_sphere(12, 24)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_means_no_rotation(backend, dtype):
    scene, plain = random_scene(n=10).to(dtype), random_scene(n=10).to(dtype)
    scene.quats[::2] = 0.0
    plain.quats[::2] = torch.tensor([1.0, 0, 0, 0], dtype=dtype)
    got, want = render(scene, origin(), GRID, backend), render(plain, origin(), GRID, backend)
    assert torch.equal(got["image"], want["image"]) and torch.equal(got["d_means"], want["d_means"])
    assert (got["d_quats"][::2] == 0).all() and torch.isfinite(got["d_quats"]).all()
    assert (got["d_quats"][1::2] != 0).any()


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-12, 1e12, 1e20])
def test_equals_float64(backend, size):
    scene = random_scene(n=10)
    scene.quats[::2] *= size
    assert_equals_float64(scene.to(torch.float32).to(torch.float64), origin(), GRID, backend)

"""Seam: footprints cut at azimuth +-pi, because a tile rectangle is clamped to the image.

Remedy: boxes wrap modulo the width and pixel offsets take the nearest image (csrc/project.h,
csrc/pixels.h). Shown: rotating the world about the boresight by k columns rolls image and
gradients. Tolerance 1e-10 in float64: the rotated positions differ in their last bits.
"""

import math
from dataclasses import replace

import pytest
import torch
from rasters import PROJECTIONS, assert_equals_float64, one, origin, random_scene, render

from gsparc.ops import Pose, SphereGrid

GRID = SphereGrid.hemisphere(20, 72)


def turn_about_boresight(columns: int) -> torch.Tensor:
    angle = columns * GRID.azimuth_step
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)


@PROJECTIONS
@pytest.mark.parametrize("columns", [1, 17, 36, 71])
def test_turning_the_world_rolls_the_image(backend, projection, columns):
    scene, turn = random_scene(n=30, seed=1), turn_about_boresight(columns)
    noise = torch.randn(3, 2, 20, 72, dtype=torch.float64)
    still = Pose(torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    before = render(
        scene, still, GRID, backend, upstream=noise, behind=False, projection=projection
    )
    # The world turned by `turn` is the receiver turned back:
    # everything of the Gaussians stays the same.
    turned = Pose(still.position, turn.mT)
    rolled = noise.roll(columns, -1)
    after = render(
        scene, turned, GRID, backend, upstream=rolled, behind=False, projection=projection
    )
    assert (after["image"] - before["image"].roll(columns, -1)).abs().max() < 1e-10
    for name in ("d_means", "d_quats", "d_scales", "d_opacities", "d_features", "d_means2d"):
        gap = (after[name] - before[name]).abs().max() / (1 + before[name].abs().max())
        assert gap < 1e-10, name


@PROJECTIONS
def test_footprint_wider_than_the_circle_counts_each_pixel_once(backend, projection):
    """A single layer is at most its opacity anywhere; counted twice it would exceed it."""
    scene = replace(
        one([0.3, 0.1, 0.9], sigma=3.0, opacity=0.5), features=torch.ones(1, 1, 1).double()
    )
    image = render(scene, origin(), GRID, backend, projection=projection, compensate=False)["image"]
    assert image.max() <= 0.5
    want = render(scene, origin(), GRID, "reference", projection=projection, compensate=False)[
        "image"
    ]
    assert (image - want).abs().max() < 1e-12


@PROJECTIONS
@pytest.mark.parametrize("azimuth", [-1e-7, 0.0, 1e-7, math.pi - 1e-7, math.pi, math.pi + 1e-7])
def test_equals_float64(backend, projection, azimuth):
    scene = one([math.cos(azimuth), math.sin(azimuth), 0.4], sigma=0.6)
    assert_equals_float64(scene, origin(), GRID, backend, projection=projection)

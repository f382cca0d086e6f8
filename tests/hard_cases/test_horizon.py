"""Horizon: Gaussians culled by their mean vanish at once when it sinks below the first row.

Remedy: boxes by extent, never by mean (csrc/boxes.h). Shown: the sum over the visible rows follows
the integral of the footprint over them, without a jump: one step of the sweep is worth at most 8 %
of the whole. Tolerance 0.2 % of the whole for `equirect` (measured 0.14 %: the footprint's width is
linearised) and 1 % for `tangent` (measured 0.75 %: the plane bends away from the sphere).
"""

import math
from itertools import pairwise

import pytest
import torch
from rasters import PROJECTIONS, assert_equals_float64, one, origin, render

from gsparc.ops import Cutoff, SphereGrid

GRID = SphereGrid.hemisphere(30, 120)
FAR = 4.0
SIGMA = 0.5
TOLERANCE = {"equirect": 2e-3, "tangent": 1e-2}


def share_above(elevation: float) -> float:
    """Share of the footprint above the lower edge of row 0, half a step below its centre."""
    spread = math.hypot(SIGMA / FAR, math.sqrt(0.3) * GRID.elevation_step)
    return 0.5 * math.erfc(-(elevation + GRID.elevation_step / 2) / (math.sqrt(2) * spread))


@PROJECTIONS
def test_share_follows_the_integral(backend, projection):
    heights = torch.linspace(-0.35, 0.35, 29).tolist()
    sums = []
    for elevation in heights:
        scene = one(
            [math.cos(elevation), 0.1, math.sin(elevation)], distance=FAR, sigma=SIGMA, opacity=0.5
        )
        optics = {"projection": projection, "cutoff": Cutoff(1e-4, 0.0, relative=True)}
        image = render(scene, origin(), GRID, backend, **optics)["image"][0, 0].double()
        weight = (
            GRID.solid_angles() if projection == "tangent" else torch.full((30, 120), 1.0).double()
        )
        if projection == "equirect":  # its footprint is wider by 1 / cos(elevation)
            weight = weight * math.cos(elevation)
        sums.append(float((image * weight).sum()))
    whole = sums[-1] / share_above(heights[-1])
    for elevation, got in zip(heights, sums, strict=True):
        assert abs(got / whole - share_above(elevation)) < TOLERANCE[projection], elevation
    assert max(abs(a - b) for a, b in pairwise(sums)) < 0.085 * whole


@PROJECTIONS
@pytest.mark.parametrize("elevation", [-0.3, -0.1, 0.0, 0.1])
def test_equals_float64(backend, projection, elevation):
    scene = one(
        [math.cos(elevation), 0.1, math.sin(elevation)], distance=FAR, sigma=SIGMA, opacity=0.5
    )
    assert_equals_float64(scene, origin(), GRID, backend, projection=projection)

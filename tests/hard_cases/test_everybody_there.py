"""Everybody there: a Gaussian that covers every strip, and a million of them.

Remedy: entries are counted before they are allocated, and refused with a clear line beyond a bound
(operators.py). Shown: one giant costs one entry per strip; a million huge ones stay within the
stated bytes: entries (4 B each) + records, boxes and orders (under 200 B each)
+ as much again while planning.
"""

import pytest
import torch
from rasters import PROJECTIONS, assert_equals_float64, one, origin, random_scene, render

from gsparc.ops import SphereGrid, composite, make_plan, operators

GRID = SphereGrid.hemisphere()
SMALL = SphereGrid.full_sphere(20, 40)


@PROJECTIONS
@pytest.mark.parametrize("sigma", [4.0, 40.0, 4e3])
def test_a_giant_equals_float64(backend, projection, sigma):
    scene = one([1.0, 0.0, 1.0], sigma=sigma, opacity=0.5)
    assert_equals_float64(scene, origin(), SMALL, backend, projection=projection)


def test_one_giant_covers_every_strip():
    scene = one([1.0, 0.0, 1.0], sigma=40.0, opacity=0.5)
    plan = make_plan(*scene.model, origin(), GRID)
    assert plan.buffers[6].numel() == operators.count_strips(GRID.height)
    image = render(scene, origin(), GRID)["image"]
    assert torch.isfinite(image).all() and (image > 0.1).double().mean() > 0.8


def test_too_many_entries_are_refused_before_allocation(monkeypatch):
    scene = random_scene(n=300, size=4.0)
    model = scene.model
    plan = make_plan(*model, origin(), GRID)
    entries = plan.buffers[6].numel()
    monkeypatch.setattr(operators, "MEMORY_BOUND", entries * 8 * 10)
    leaf = scene.means.clone().requires_grad_()
    raster = composite(plan, leaf, *model[1:], scene.features)
    with pytest.raises(MemoryError, match="use fewer or smaller Gaussians"):
        raster.image.sum().backward()

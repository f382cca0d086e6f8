"""Stages of the rasterizer apart and together, frozen views, backends that are not there."""

import re

import pytest
import torch
from rasters import GRIDS, poses, random_scene
from refusals import refused

from gsparc.ops import (
    BackendUnavailable,
    SphereGrid,
    StalePlan,
    composite,
    cuda_library,
    freeze,
    make_plan,
    rasterize,
)
from gsparc.ops.geometry import WIDEST_GRID

GRID = GRIDS["hemisphere"]


def test_the_widest_grid_is_drawn_to_its_last_column():
    scene, width = random_scene(n=20, samples=1), WIDEST_GRID
    grid = SphereGrid(1, width, 0.2, 0.0, 0.1, 2 * torch.pi / width)
    one, other = (
        rasterize(*scene.model, scene.features, poses(0), grid, backend=b).image for b in ("cpu", "reference")
    )
    assert (one - other).abs().max() < 1e-12 and other.abs().max() > 0.01


def test_absent_backends_say_why():
    scene = random_scene(n=4)
    reason = cuda_library.missing_device() or "needs tensors on cuda"
    with pytest.raises(BackendUnavailable, match=re.escape(reason)):
        make_plan(*scene.model, poses(0), GRID, backend="cuda")
    refused("backend is", make_plan, *scene.model, poses(0), GRID, backend="tpu")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("channels", [0, 1, 3, 8, 9, 19, 70])
@pytest.mark.parametrize("samples", [1, 2])
def test_frozen_view_of_any_number_of_channels(channels, samples, dtype):
    """Few channels add neighbouring blocks apart, many all at once."""
    scene, pose = random_scene(n=300, channels=channels, samples=samples).to(dtype), poses(0)
    plan = make_plan(*scene.model, pose, GRIDS["patch"])
    frozen = freeze(plan, *scene.model, version=0)
    want = composite(plan, *scene.model, scene.features).image
    close = {"rtol": 0, "atol": 1e-12 if dtype == torch.float64 else 1e-5}
    assert torch.allclose(frozen.render(scene.features, version=0), want, **close)
    assert torch.allclose(frozen.render(scene.features[0], version=0), want[0], **close)
    assert torch.allclose(frozen.render_visible(scene.features[:, frozen.order]), want, **close)


def test_plans_and_views_of_other_fields_are_refused():
    scene, few = random_scene(), random_scene(n=4)
    frozen = freeze(make_plan(*scene.model, poses(0), GRID), *scene.model, version=3)
    with pytest.raises(StalePlan, match="version 3, the field is at 4"):
        frozen.render(scene.features, version=4)
    refused("one pose", freeze, make_plan(*scene.model, poses(2), GRID), *scene.model, version=0)
    refused("plan again", composite, make_plan(*few.model, poses(0), GRID), *scene.model, scene.features)

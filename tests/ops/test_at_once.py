"""Plan and image in one call, where nothing is trained: the bits of one after the other.

The refusals: test_validation.py.
"""

import pytest
import torch
from compute_kernels import assert_threads_agree
from rasters import GRIDS, poses, random_scene

from gsparc.ops import composite, make_plan, native, operators, rasterize

FIELDS = ("image", "transmittance", "radii", "visible", "means2d")


@pytest.fixture
def at_once(monkeypatch):
    """Counts the calls that take the short way."""
    calls, plain = [], native.rasterize

    def counted(*arguments):
        calls.append(len(arguments))
        return plain(*arguments)

    monkeypatch.setattr(native, "rasterize", counted)
    return calls


def both(scene, pose, grid=GRIDS["hemisphere"], **optics):
    """Rasters in one call and in two."""
    model = scene.model
    plan = make_plan(*model, pose, grid, ids=scene.ids, **optics)
    apart = composite(plan, *model, scene.features)
    return rasterize(*model, scene.features, pose, grid, ids=scene.ids, **optics), apart


def assert_alike(pair):
    one, two = pair
    for name in FIELDS:
        assert torch.equal(getattr(one, name), getattr(two, name)), name
    return one


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("count", [0, 3], ids=["shared", "each"])
def test_same_bits(at_once, projection, dtype, grid, count):
    scene, pose = random_scene(n=200).to(dtype), poses(count)
    found = assert_alike(both(scene, pose, GRIDS[grid], projection=projection))
    assert len(at_once) == 1 and (found.image != 0).any()


def test_any_number_of_threads_is_the_same_bits(at_once):
    scene = random_scene(n=3000).to(torch.float32)
    assert_threads_agree(lambda: [assert_alike(both(scene, poses(3))).image])
    assert len(at_once) == 3


def test_gradients_take_the_plan(at_once):
    scene, pose = random_scene(), poses(0)
    model = [scene.means.clone().requires_grad_(), scene.quats, scene.scales, scene.opacities]
    image = rasterize(*model, scene.features, pose, GRIDS["sphere"]).image
    assert image.requires_grad and not at_once
    with torch.no_grad():
        again = rasterize(*model, scene.features, pose, GRIDS["sphere"]).image
    assert torch.equal(again, image) and not again.requires_grad and len(at_once) == 1


def test_too_many_entries_are_refused_before_allocation(at_once, monkeypatch):
    scene = random_scene(n=300, size=4.0)
    monkeypatch.setattr(operators, "MEMORY_BOUND", 100)
    with pytest.raises(MemoryError, match="use fewer or smaller Gaussians"):
        both(scene, poses(0))
    model = scene.model
    with pytest.raises(MemoryError, match="use fewer or smaller Gaussians"):
        rasterize(*model, scene.features, poses(0), GRIDS["sphere"])
    assert len(at_once) == 1

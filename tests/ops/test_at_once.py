"""Plan and image in one call, where nothing is trained: the bits of one after the other.

The refusals: test_validation.py.
"""

from dataclasses import replace

import pytest
import torch
from compute_kernels import assert_threads_agree
from rasters import GRIDS, poses, random_scene

from gsparc.ops import Pose, composite, make_plan, native, operators, rasterize

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
    options = {"extinctions": scene.extinctions, "ids": scene.ids}
    plan = make_plan(*model, pose, grid, **options, **optics)
    apart = composite(plan, *model, scene.features, extinctions=scene.extinctions)
    return rasterize(*model, scene.features, pose, grid, **options, **optics), apart


def assert_alike(pair):
    one, two = pair
    for name in FIELDS:
        assert torch.equal(getattr(one, name), getattr(two, name)), name
    return one


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("count", [0, 3], ids=["shared", "each"])
@pytest.mark.parametrize("hides", [False, True], ids=["plain", "extinctions"])
def test_same_bits(at_once, projection, dtype, grid, count, hides):
    scene, pose = random_scene(n=200, hides=hides).to(dtype), poses(count)
    found = assert_alike(both(scene, pose, GRIDS[grid], projection=projection))
    assert len(at_once) == 1 and (found.image != 0).any()


def cases():
    scene = random_scene(n=40)
    yield "nobody", random_scene(n=0)
    yield "all below", replace(scene, means=scene.means * 0.1 - torch.tensor([0.0, 0.0, 9.0]).double())
    yield "at the receiver", replace(scene, means=scene.means * 0)
    yield "giants", replace(scene, scales=scene.scales * 100)
    yield "needles", replace(scene, scales=scene.scales * torch.tensor([30.0, 1e-4, 1e-4]).double())
    yield "transparent", replace(scene, opacities=scene.opacities * 0)
    yield "ids backwards", replace(scene, ids=torch.arange(40).flip(0))
    yield "one sample", replace(scene, features=scene.features[0])
    yield "no channel", replace(scene, features=scene.features[..., :0])
    yield "five channels", random_scene(n=40, channels=5)
    yield "in strides", replace(scene, means=scene.means.T.contiguous().T, features=scene.features.flip(0))


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
@pytest.mark.parametrize("name,scene", [pytest.param(*case, id=case[0]) for case in cases()])
def test_hard_cases_are_the_same_bits(at_once, name, scene, projection):
    pose = Pose.identity(torch.zeros(3).double())
    assert_alike(both(scene, pose, projection=projection))
    assert len(at_once) == 1


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


def test_features_whose_sum_overflows_are_finite(at_once):
    scene = random_scene()
    assert_alike(both(replace(scene, features=torch.full_like(scene.features, 1e308)), poses(0)))
    assert len(at_once) == 1


def test_too_many_entries_are_refused_before_allocation(at_once, monkeypatch):
    scene = random_scene(n=300, size=4.0)
    monkeypatch.setattr(operators, "MEMORY_BOUND", 100)
    with pytest.raises(MemoryError, match="use fewer or smaller Gaussians"):
        both(scene, poses(0))
    model = scene.model
    with pytest.raises(MemoryError, match="use fewer or smaller Gaussians"):
        rasterize(*model, scene.features, poses(0), GRIDS["sphere"])
    assert len(at_once) == 1

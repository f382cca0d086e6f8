"""The operators obey torch.library's rules and exist once; the package has one name."""

import ctypes
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.utils.flop_counter
from rasters import poses, random_scene
from torch._subclasses import FakeTensorMode
from torch.library import opcheck

from gsparc.ops import (
    SphereGrid,
    _native,
    calls,
    composite,
    make_plan,
    operators,
)
from gsparc.ops.projection import PROJECTIONS
from gsparc.ops.settings import Optics, kernel_settings

ROOT = Path(__file__).parents[2]
GRID = SphereGrid.hemisphere(10, 40)


@pytest.mark.parametrize("hides", [False, True], ids=["plain", "extinctions"])
def test_opcheck(hides):
    scene, pose = random_scene(n=7, samples=2, hides=hides), poses(2)
    model = (scene.means, scene.quats, scene.scales, scene.opacities)
    plan = make_plan(*model, pose, GRID, extinctions=scene.extinctions)
    view = (pose.position, pose.rotation)
    settings = operators.packed(kernel_settings(GRID, plan.optics))
    leaves = [tensor.clone().requires_grad_() for tensor in model]
    hidden = scene.extinctions.clone().requires_grad_() if hides else None
    features, means2d = scene.features.clone().requires_grad_(), plan.means2d.clone().requires_grad_()
    opcheck(operators.plan_op.defined, (*model, None, None, *view, settings))
    rest = (*view, *plan.buffers, settings)
    opcheck(operators.composite_op.defined, (means2d, *leaves, hidden, features, *rest))
    opcheck(operators.weights_op.defined, (*leaves, hidden, *rest))


@pytest.mark.parametrize("hides", [False, True], ids=["plain", "extinctions"])
@pytest.mark.parametrize("behind", [False, True], ids=["image", "transmittance"])
def test_opcheck_of_the_gradients(hides, behind):
    scene, pose = random_scene(n=7, samples=2, hides=hides), poses(2)
    model = (scene.means, scene.quats, scene.scales, scene.opacities)
    plan = make_plan(*model, pose, GRID, extinctions=scene.extinctions)
    common = (*model, scene.extinctions)
    view = (pose.position, pose.rotation, *plan.buffers, operators.packed(kernel_settings(GRID, plan.optics)))
    raster = composite(plan, *model, scene.features, extinctions=scene.extinctions)
    light = torch.ones_like(raster.transmittance) if behind else None
    images = (torch.ones_like(raster.image), light, raster.image, raster.transmittance)
    opcheck(operators.composite_backward_op.defined, (*images, *common, scene.features, *view))
    seen = operators.weights_op(*common, *view)
    opcheck(
        operators.weights_backward_op.defined, (*[torch.ones_like(part) for part in seen], *common, *view)
    )


def test_bare_import_is_refused_with_a_reason():
    code = "import gsparc.ops, sys; sys.path.insert(0, '.'); import ops"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode != 0
    assert "installed as gsparc.ops" in done.stderr and "registered" not in done.stderr


def test_importing_twice_registers_once():
    code = (
        "import gsparc.ops.native, importlib, sys, gsparc.ops; importlib.import_module('gsparc.ops.native');"
        "import torch;"
        "ops = [o for o in torch._C._dispatch_get_all_op_names() if o.startswith('gsparc::')];"
        "assert len(ops) == len(set(ops)) == 5, ops"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_plan_allocates_nothing_it_may_not(monkeypatch):
    scene = random_scene(n=50, size=4.0)
    model = (scene.means, scene.quats, scene.scales, scene.opacities)
    monkeypatch.setattr(operators, "MEMORY_BOUND", 100)
    with pytest.raises(MemoryError, match="footprint entries need"):
        make_plan(*model, poses(0), GRID)


def test_inputs_on_strides_are_understood():
    scene, pose = random_scene(n=9), poses(0)
    wide = torch.empty(9, 6, dtype=torch.float64)[:, ::2]
    wide.copy_(scene.means)
    plain = make_plan(scene.means, scene.quats, scene.scales, scene.opacities, pose, GRID)
    strided = make_plan(wide, scene.quats, scene.scales, scene.opacities, pose, GRID)
    for a, b in zip(plain.buffers, strided.buffers, strict=True):
        assert torch.equal(a, b)
    rest = (scene.quats, scene.scales, scene.opacities, scene.features)
    assert torch.equal(composite(plain, scene.means, *rest).image, composite(strided, wide, *rest).image)


def test_every_device_has_every_operator():
    for module in ("native", "cuda", "channels", "networks", "similarity"):
        importlib.import_module(f"gsparc.ops.{module}")
    missing = operators.KERNELS["cpu"].keys() ^ operators.KERNELS["cuda"].keys()
    assert missing == {"channels", "channels_backward"}  # on a GPU they are summed in PyTorch
    assert len(operators.KERNELS["cuda"]) == 8
    for name in operators.KERNELS["cpu"]:
        assert f"gsparc::{name}" in str(getattr(torch.ops.gsparc, name).default._schema)


def test_calls_have_the_layout_of_the_kernels():
    assert ctypes.sizeof(calls.Call) == _native.CALL_BYTES
    assert list(PROJECTIONS) == _native.PROJECTIONS


def test_arguments_of_an_operator_have_names():
    """Settings travel as one list and arrive by name, each in its own type."""
    schema = str(torch.ops.gsparc.weights.default._schema)
    assert "Tensor? extinctions" in schema and "Tensor entries, float[] settings" in schema
    settings = kernel_settings(GRID, Optics(projection="equirect"))
    again = operators._unpacked((operators.packed(settings),))
    assert again == settings and list(map(type, again)) == list(map(type, settings))


def test_a_call_past_the_dispatcher_is_the_same_and_never_hides_anything():
    """Only what torch would pass on goes straight to the kernel: no gradient, mode or trace is missed."""
    scene, pose = random_scene(n=9), poses(0)
    model = [t.clone().requires_grad_() for t in (scene.means, scene.quats, scene.scales, scene.opacities)]
    assert not operators.unwatched(model)
    with torch.no_grad():
        assert operators.unwatched(model)
        with torch.utils.flop_counter.FlopCounterMode(display=False):
            assert not operators.unwatched(model)
        with torch.autograd.forward_ad.dual_level():
            assert not operators.unwatched(model)
        with FakeTensorMode() as fake:
            assert not operators.unwatched([fake.from_tensor(model[0])])
        plan = make_plan(*model, pose, GRID)
        straight = composite(plan, *model, scene.features).image
    recorded = composite(plan, *model, scene.features).image
    assert recorded.requires_grad and torch.equal(straight, recorded)


def test_the_page_shows_every_operator_where_it_is_computed_and_tested():
    for module in ("native", "cuda", "channels", "networks", "similarity"):
        importlib.import_module(f"gsparc.ops.{module}")
    page = (ROOT / "docs" / "reference" / "rasterizer.md").read_text(encoding="utf-8")
    rows = [
        [cell.strip(" `") for cell in line.split("|")[1:-1]]
        for line in page.splitlines()
        if line[:3] == "| `"
    ]
    shown = {name: (*found, tested) for name, _, *found, tested in rows}
    assert shown.keys() == operators.KERNELS["cpu"].keys()
    for name, (*found, tested) in shown.items():
        served = [operators.KERNELS[device].get(name) for device in ("cpu", "cuda")]
        wanted = [f and f"{f.__module__.split('.')[-1]}.{f.__name__}" for f in served]
        assert found == [function or "PyTorch" for function in wanted], name
        assert name in (ROOT / tested).read_text(encoding="utf-8")

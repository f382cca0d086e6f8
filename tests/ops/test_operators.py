"""Every operator has a kernel on each device, the layout that C++ reads, and its row on the page."""

import csv
import ctypes
import importlib
from pathlib import Path

import torch
from rasters import poses, random_scene

from gsparc.ops import SphereGrid, _native, calls, composite, make_plan, operators
from gsparc.ops.projection import PROJECTIONS

ROOT = Path(__file__).parents[2]
for module in ("native", "cuda", "similarity"):
    importlib.import_module(f"gsparc.ops.{module}")


def test_inputs_on_strides_are_understood():
    scene, pose, grid = random_scene(n=9), poses(0), SphereGrid.hemisphere(10, 40)
    wide = torch.empty(9, 6, dtype=torch.float64)[:, ::2]
    wide.copy_(scene.means)
    rest = (scene.quats, scene.scales, scene.opacities)
    plain, strided = (make_plan(means, *rest, pose, grid) for means in (scene.means, wide))
    assert all(torch.equal(a, b) for a, b in zip(plain.buffers, strided.buffers, strict=True))
    images = [
        composite(plan, means, *rest, scene.features).image
        for plan, means in ((plain, scene.means), (strided, wide))
    ]
    assert torch.equal(*images)


def test_calls_have_the_layout_of_the_kernels():
    assert ctypes.sizeof(calls.Call) == _native.CALL_BYTES
    assert list(PROJECTIONS) == _native.PROJECTIONS


def test_the_table_has_every_operator_and_what_computes_it():
    with (ROOT / "docs" / "reference" / "operators.csv").open(encoding="utf-8", newline="") as file:
        _, *rows = csv.reader(file)
    shown = {name: computed for name, _, *computed in rows}
    assert shown.keys() == operators.KERNELS["cpu"].keys()
    for name, computed in shown.items():
        served = [operators.KERNELS[device].get(name) for device in ("cpu", "cuda")]
        wanted = [f and f"{f.__module__.split('.')[-1]}.{f.__name__}" for f in served]
        assert computed == [function or "PyTorch" for function in wanted], name

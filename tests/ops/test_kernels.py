"""The kernels against the float64 reference, their stages apart and together,
and the list of them.
"""

import csv
import ctypes
import importlib
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from compute_kernels import SETS, instruction_set
from rasters import (
    GRIDS,
    PROJECTIONS,
    TOLERANCES,
    assert_close,
    assert_equals_reference,
    one,
    origin,
    poses,
    random_scene,
    render,
    truth,
)
from refusals import refused

from gsparc.ops import (
    BackendUnavailable,
    Cutoff,
    SphereGrid,
    StalePlan,
    _native,
    calls,
    composite,
    cuda_library,
    freeze,
    make_plan,
    mean_weights,
    operators,
    projection,
    rasterize,
)
from gsparc.ops.geometry import WIDEST_GRID

BOTH = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])


@BOTH
@PROJECTIONS
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
@pytest.mark.parametrize("count", [0, 3], ids=["shared", "posed"])
def test_equals_reference(dtype, projection, grid, count):
    scene, pose = random_scene(seed=count), poses(count)
    got, want = assert_equals_reference(scene, pose, grid, dtype, projection=projection)
    assert not (want["visible"] & ~got["visible"]).any()
    assert torch.allclose(
        got["radii"][want["visible"]].double(), want["radii"][want["visible"]], rtol=1e-4
    )


@PROJECTIONS
@pytest.mark.parametrize(
    "optics",
    [
        {"compensate": False},
        {"low_pass": 0.0},
        {"cutoff": Cutoff(0.01, 1e-4, relative=True)},
        {"near": 1.5},
    ],
    ids=["uncompensated", "sharp", "relative", "fading"],
)
def test_switches_equal_reference(projection, optics):
    scene = random_scene(seed=7)
    assert_equals_reference(scene, poses(0), GRIDS["hemisphere"], projection=projection, **optics)


@BOTH
@PROJECTIONS
def test_weights_equal_reference(dtype, projection):
    scene, pose, grid = random_scene(seed=2), poses(2), GRIDS["hemisphere"]
    cut = Cutoff(1e-3, 1e-4, relative=True)
    results = {}
    for backend, kind in (("reference", torch.float64), ("cpu", dtype)):
        cast = scene.to(kind)
        leaves = [leaf.clone().requires_grad_() for leaf in cast.model]
        plan = make_plan(*leaves, pose, grid, projection=projection, cutoff=cut, backend=backend)
        seen = mean_weights(plan, *leaves)
        draw = torch.Generator().manual_seed(3)
        a, b = (
            torch.randn(seen.mean.shape, generator=draw, dtype=torch.float64).to(kind)
            for _ in range(2)
        )
        (1000 * (seen.mean * a).sum() + (seen.share * b).sum()).backward()
        values = [seen.mean.detach(), seen.share.detach(), *(leaf.grad for leaf in leaves)]
        results[backend] = dict(enumerate(values))
    assert_close(results["cpu"], results["reference"], TOLERANCES[dtype])


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("away", [1e-19, 1e-20, 1e-22, 1e-30])
def test_a_hair_off_the_axis_the_gradient_was_no_number(backend, away):
    """Reference, float32, `equirect`: the slopes of the root and
    of atan2 have the square of `away`.
    """
    scene = one([away, 0.0, 1.0])
    want = truth(scene, origin(), GRIDS["sphere"], projection="equirect")
    got = render(scene.to(torch.float32), origin(), GRIDS["sphere"], backend, projection="equirect")
    assert all(torch.isfinite(value).all() for value in got.values())
    if away > 1e-21:  # below, the kernel's square of it has few bits left, and then none
        assert_close(got, want, 1e-3)


@pytest.mark.parametrize("gap", [0.0, 1e-7, -1e-7, 1e-3])
@pytest.mark.parametrize("first", [0.0, -7.5])
def test_a_grid_that_nearly_closes_wrapped_by_two_periods(gap, first):
    """The kernels' period was the width, the reference's 2 pi / step."""
    scene, width = random_scene(seed=5, size=2.0), 16
    grid = SphereGrid(9, width, 0.0, first, 0.1, (1 - gap) * 2 * math.pi / width)
    assert grid.periodic == (abs(gap) < 1e-6)
    assert grid.per_turn == pytest.approx(2 * math.pi / grid.azimuth_step)
    assert_equals_reference(scene, poses(3), grid, projection="equirect")


def test_weights_are_the_image_of_indicators():
    scene, pose, grid = random_scene(n=12, seed=4), poses(0), GRIDS["hemisphere"]
    model = scene.model
    seen = mean_weights(make_plan(*model, pose, grid), *model)
    image = rasterize(*model, torch.eye(12, dtype=torch.float64), pose, grid).image[0]
    assert torch.allclose(seen.mean[0], image.mean((1, 2)), atol=1e-12)
    assert (seen.share >= 0).all() and (seen.share <= 1).all() and seen.share.max() > 0.9


@pytest.mark.parametrize("channels,samples", [(1, 1), (3, 5), (40, 2), (0, 2), (2, 0)])
def test_any_number_of_channels_and_samples(channels, samples):
    scene = random_scene(channels=channels, samples=samples, seed=9)
    got, _ = assert_equals_reference(scene, poses(0), GRIDS["sphere"])
    assert got["image"].shape == (samples, channels, 24, 48)


def test_kernels_of_another_compiler_were_the_slowest_ones():
    """The runtime library of zig's clang says of every instruction set
    that the processor lacks it.
    """
    told = Path("/proc/cpuinfo")
    flags = re.search(r"^flags\s*:(.*)", told.read_text() if told.exists() else "", re.MULTILINE)
    if flags is None:
        pytest.skip("no /proc/cpuinfo of an x86 processor")
    has = set(flags[1].split())
    wide = {"avx512f", "avx512dq", "avx512vl", "avx512bw", "bmi2", "avx2", "fma"}
    best = "avx512" if wide <= has else "avx2" if {"avx2", "fma"} <= has else "baseline"
    asks = (
        "import sys, importlib.util as u; s = u.spec_from_file_location('_native', sys.argv[1]);"
        "m = u.module_from_spec(s); s.loader.exec_module(m); print(m.instruction_set())"
    )
    # A process of its own, because another test may have chosen one here.
    command = [sys.executable, "-c", asks, _native.__file__]
    assert (
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == best
    )


@SETS
@BOTH
@PROJECTIONS
def test_every_instruction_set(name, dtype, projection):
    with instruction_set(name):
        scene = random_scene(seed=11)
        assert_equals_reference(scene, poses(3), GRIDS["hemisphere"], dtype, projection=projection)


@pytest.mark.slow
@PROJECTIONS
@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("seed", [3, 4])
def test_gradcheck(projection, backend, seed):
    """Every derivative by finite differences, with cut-offs so low that none is crossed."""
    scene = random_scene(n=4, seed=seed)
    cut = Cutoff(1e-30, 0.0, relative=seed == 4)
    features = scene.features[:2, :, :1]
    inputs = [scene.means, scene.quats, scene.scales, scene.opacities, features]
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    kind = {"projection": projection, "cutoff": cut, "backend": backend}

    def picture(m, q, s, o, f):
        raster = rasterize(m, q, s, o, f, poses(2), SphereGrid.full_sphere(3, 6), **kind)
        return raster.image, raster.transmittance

    def weights(m, q, s, o):
        plan = make_plan(m, q, s, o, poses(2), SphereGrid.full_sphere(3, 6), **kind)
        seen = mean_weights(plan, m, q, s, o)
        return seen.mean, seen.share

    assert torch.autograd.gradcheck(picture, inputs, atol=1e-6)
    assert torch.autograd.gradcheck(weights, inputs[:4], atol=1e-6)


def test_clamped_layers_pass_gradient_to_features_only():
    scene = one([1.0, 0, 0.5], opacity=1.0, sigma=3.0)
    grid = SphereGrid(
        1, 1, float(torch.atan2(torch.tensor(0.5), torch.tensor(1.0))), 0.0, 0.01, 0.01
    )
    for backend in ("cpu", "reference"):
        got = render(scene, origin(), grid, backend, behind=False)
        assert float(got["image"]) == 0.99
        assert got["d_features"].abs().max() > 0
        for name in ("d_means", "d_quats", "d_scales", "d_opacities", "d_means2d"):
            assert (got[name] == 0).all(), name


def test_screen_gradient_is_the_shift_of_the_footprint():
    """means2d.grad: a tiny sideways move of a round footprint, per pose, in pixels."""
    scene, grid, step = one([1.0, 0.2, 0.7], sigma=0.3), SphereGrid.hemisphere(), 1e-5
    got = render(scene, origin(), grid, projection="equirect")
    turned = []
    for sign in (1, -1):
        angle = torch.tensor(sign * step * grid.azimuth_step, dtype=torch.float64)
        c, s, z = angle.cos(), angle.sin(), torch.zeros_like(angle)
        turn = torch.stack([c, -s, z, s, c, z, z, z, z + 1]).reshape(3, 3)
        moved = type(scene)(**{**vars(scene), "means": scene.means @ turn.mT})
        picture = render(moved, origin(), grid, projection="equirect")
        draw = torch.Generator().manual_seed(5)
        loss = 0.0
        for name in ("image", "transmittance"):
            noise = torch.randn(picture[name].shape, generator=draw, dtype=torch.float64)
            loss = loss + (noise * picture[name]).sum()
        turned.append(loss)
    slope = (turned[0] - turned[1]) / (2 * step)
    assert torch.isclose(got["d_means2d"][0, 0, 0], slope, rtol=1e-4)


GRID = GRIDS["hemisphere"]


def test_the_widest_grid_is_drawn_to_its_last_column():
    scene, width = random_scene(n=20, samples=1), WIDEST_GRID
    grid = SphereGrid(1, width, 0.2, 0.0, 0.1, 2 * torch.pi / width)
    one, other = (
        rasterize(*scene.model, scene.features, poses(0), grid, backend=b).image
        for b in ("cpu", "reference")
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
    refused(
        "plan again", composite, make_plan(*few.model, poses(0), GRID), *scene.model, scene.features
    )


ROOT = Path(__file__).parents[2]


def test_calls_have_the_layout_of_the_kernels():
    assert ctypes.sizeof(calls.Call) == _native.CALL_BYTES
    assert list(projection.PROJECTIONS) == _native.PROJECTIONS


def test_the_table_has_every_operator_and_what_computes_it():
    with (ROOT / "docs" / "reference" / "operators.csv").open(encoding="utf-8", newline="") as file:
        _, *rows = csv.reader(file)
    for module in ("native", "cuda", "similarity"):
        importlib.import_module(f"gsparc.ops.{module}")
    shown = {name: computed for name, _, *computed in rows}
    assert shown.keys() == operators.KERNELS["cpu"].keys()
    for name, computed in shown.items():
        served = [operators.KERNELS[device].get(name) for device in ("cpu", "cuda")]
        wanted = [f and f"{f.__module__.split('.')[-1]}.{f.__name__}" for f in served]
        assert computed == [function or "PyTorch" for function in wanted], name

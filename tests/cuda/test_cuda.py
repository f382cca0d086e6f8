"""What only the CUDA kernels do: long lists, graphs, frozen blocks; on the shim, and on a GPU."""

import pytest
import torch
from rasters import GRIDS, Scene, assert_close, origin, poses, random_scene, render, truth

from gsparc.ops import SphereGrid, calls, cuda, make_plan, operators, rasterize

BOTH = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])


def crowd(n: int = 700) -> Scene:
    """Wide Gaussians on a few tiles: a block walks its list several times,
    and light ends inside.
    """
    scene = random_scene(n=n, seed=12, size=1.5)
    scene.opacities[:] *= 0.6
    return scene


@BOTH
@pytest.mark.parametrize("projection", ["tangent", "equirect"])
def test_long_lists_equal_the_reference(where, dtype, projection):
    scene, grid = crowd(), SphereGrid.full_sphere(8, 24)
    want = truth(scene, poses(3), grid, projection=projection)
    assert want["transmittance"].min() < 1e-4 < want["transmittance"].max()
    got = render(scene.to(dtype), poses(3), grid, projection=projection)
    assert_close(got, want, 1e-9 if dtype == torch.float64 else 1e-4)


def test_order_of_the_threads_does_not_matter(where):
    """A missing barrier shows when a block's threads run in the opposite order; on a GPU,
    run it twice.
    """
    scene = crowd(200).to(torch.float32)
    first = render(scene, poses(3), GRIDS["hemisphere"])
    turned = (
        calls.libraries["cpu"]._loaded.gsparc_shim_backwards if where == "shim" else lambda on: None
    )
    turned(1)
    second = render(scene, poses(3), GRIDS["hemisphere"])
    turned(0)
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@BOTH
def test_nothing_is_read_before_it_is_written(where, dtype):
    """Scratch and outputs that start as NaN and the largest integers change nothing."""
    scene = random_scene(n=40).to(dtype)
    want = [render(scene, poses(count), GRIDS["patch"]) for count in (0, 3)]
    torch.use_deterministic_algorithms(True)
    try:
        got = [render(scene, poses(count), GRIDS["patch"]) for count in (0, 3)]
    finally:
        torch.use_deterministic_algorithms(False)
    for a, b in zip(want, got, strict=True):
        assert all(torch.equal(a[name], b[name]) for name in a)


def test_too_many_pairs_for_one_plan_are_refused(where, monkeypatch):
    scene = random_scene(n=40)
    monkeypatch.setattr(cuda, "MOST_PAIRS", 100)
    with pytest.raises(MemoryError, match="3 poses of 40 Gaussians are too many for a plan"):
        make_plan(*scene.model, poses(3), GRIDS["patch"])


def test_tables_that_a_graph_holds_are_never_freed(where):
    scene = random_scene(n=4)
    model = scene.model
    tables = []
    for height in [20, *range(21, 60), 20]:
        make_plan(*model, origin(), SphereGrid(height, 8, -0.3, 2.5, 0.01, 0.05))
        tables.append(cuda._sincos.cache_info().misses)
    assert tables[-1] == tables[-2]


def test_captured_plan_with_headroom_is_the_plan(where, monkeypatch):
    scene = random_scene(n=40).to(torch.float32)
    want = render(scene, poses(3), GRIDS["hemisphere"])
    monkeypatch.setattr(cuda, "_is_capturing", lambda tensor: True)
    got = render(scene, poses(3), GRIDS["hemisphere"])
    for name, value in want.items():
        assert torch.equal(value, got[name]), name


def test_captured_plan_without_room_is_nan_never_wrong(where, monkeypatch):
    scene, grid = random_scene(n=40).to(torch.float32), GRIDS["hemisphere"]
    render(scene, poses(0), grid)
    monkeypatch.setattr(cuda, "_is_capturing", lambda tensor: True)
    monkeypatch.setattr(cuda, "_capacity_with_headroom", lambda entries: 5)
    got = render(scene, poses(0), grid)
    for name in (
        "image",
        "transmittance",
        "d_means",
        "d_quats",
        "d_scales",
        "d_opacities",
        "d_features",
    ):
        assert torch.isnan(got[name]).all(), name


def test_captured_plan_needs_an_earlier_one(where, monkeypatch):
    monkeypatch.setattr(cuda, "_is_capturing", lambda tensor: True)
    monkeypatch.setattr(cuda, "_capacities", {})
    scene = random_scene(n=4)
    with pytest.raises(RuntimeError, match="plan once before capturing"):
        make_plan(*scene.model, origin(), GRIDS["patch"])


def test_too_many_entries_are_refused_before_allocation(where, monkeypatch):
    scene = crowd(60)
    model = scene.model
    plan = make_plan(*model, origin(), GRIDS["patch"])
    leaf = scene.means.clone().requires_grad_()
    image = rasterize(leaf, *model[1:], scene.features, origin(), GRIDS["patch"]).image
    monkeypatch.setattr(operators, "MEMORY_BOUND", plan.buffers[6].numel())
    with pytest.raises(MemoryError, match="use fewer or smaller Gaussians"):
        image.sum().backward()
    with pytest.raises(MemoryError, match="footprint entries need"):
        make_plan(*model, origin(), GRIDS["patch"])

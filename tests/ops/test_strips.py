"""What the walk over strips may skip unseen: tiles that are dark, columns no footprint reaches."""

import pytest
import torch
from rasters import assert_close, origin, poses, random_scene, render

from gsparc.ops import SphereGrid, _native, make_plan

PROJECTIONS = pytest.mark.parametrize("projection", ["tangent", "equirect"])


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@PROJECTIONS
def test_long_strips_of_dark_and_lit_tiles(projection):
    """More footprints than a batch holds, most behind an opaque wall: only what is dark is skipped."""
    scene = random_scene(n=300, seed=12, size=2.0)
    wall = scene.means[:, 0] > 0
    opacities = torch.where(wall, 0.97, scene.opacities)
    scene = type(scene)(**{**vars(scene), "opacities": opacities})
    grid = SphereGrid.hemisphere(15, 60)
    want = render(scene, poses(0), grid, "reference", projection=projection)
    assert (want["transmittance"] < 1e-4).double().mean() > 0.2
    assert_close(render(scene, poses(0), grid, projection=projection), want, 1e-9)


@PROJECTIONS
def test_more_tiles_than_a_word_has_bits(projection):
    """360 tiles across, footprints over the seam and all around: every pixel once."""
    scene, grid = random_scene(n=40, seed=13, size=2.0), SphereGrid.hemisphere(6, 1440)
    want = render(scene, origin(), grid, "reference", projection=projection)
    assert_close(render(scene, origin(), grid, projection=projection), want, 1e-9)


@pytest.mark.parametrize("height", [256, 257])
def test_more_strips_than_search_for_their_footprints(height):
    """Up to 64 strips pick their footprints; in a taller image each footprint is handed to its strips."""
    scene, grid = random_scene(n=1100, seed=15), SphereGrid.hemisphere(height, 8)  # more ranks than a chunk
    want = render(scene, poses(3), grid, "reference")
    assert_close(render(scene, poses(3), grid), want, 1e-9)


@pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])
@pytest.mark.parametrize("sizes", ["specks", "mixed", "needles"])
@PROJECTIONS
def test_spans_cut_no_pixel_off(name, sizes, projection):
    """Columns of a strip in closed form hold every pixel of the footprint: small or as wide as the sky,
    upright or leaning, over the seam and the poles, on whole and partial circles."""
    fastest = _native.instruction_set()
    if not _native.use_instruction_set(name):
        pytest.skip(f"this machine or build has no {name}")
    scene = random_scene(n=120, seed=19, size={"specks": 0.05, "mixed": 1.5, "needles": 0.05}[sizes])
    if sizes == "needles":
        scene = type(scene)(**{**vars(scene), "scales": scene.scales * torch.tensor([60.0, 1.0, 0.02])})
    grids = (SphereGrid.full_sphere(40, 90), SphereGrid(21, 50, 0.1, 5.5, 0.03, 0.041))
    try:
        for grid in grids:
            want = render(scene, poses(3), grid, "reference", projection=projection)
            assert_close(render(scene, poses(3), grid, projection=projection), want, 1e-9)
    finally:
        _native.use_instruction_set(fastest)


@pytest.mark.parametrize("height,width", [(1, 1), (3, 5), (5, 17), (4, 16), (7, 63)])
@PROJECTIONS
def test_grids_that_no_tile_divides(height, width, projection):
    scene = random_scene(n=30, seed=14)
    grid = SphereGrid(height, width, -0.4, 2.9, 0.11, 0.07)
    want = render(scene, poses(3), grid, "reference", projection=projection)
    assert_close(render(scene, poses(3), grid, projection=projection), want, 1e-9)


def test_a_row_through_the_pole():
    """The elevation of 90 degrees has no finite tangent, and is drawn all the same."""
    step = torch.pi / 24
    scene, grid = random_scene(n=60, seed=15, size=0.8), SphereGrid(13, 24, 0.0, -torch.pi, step, 2 * step)
    want = render(scene, origin(), grid, "reference")
    assert want["image"][..., -1, :].abs().max() > 0.1
    assert_close(render(scene, origin(), grid), want, 1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_thousands_are_ordered_alike_by_any_threads(threads, dtype):
    """Enough visible Gaussians for the parts of the radix sort, some equally far: by (depth, id)."""
    scene = random_scene(n=24_000, seed=16, size=0.02).to(dtype)
    means = torch.cat([scene.means[:12_000], -scene.means[:12_000]])  # the same distance twice
    ids = torch.randperm(24_000, generator=torch.Generator().manual_seed(3))
    model = (means, scene.quats, scene.scales, scene.opacities)
    plans = []
    for count in (1, 2, 5):
        threads(count)
        plans.append(make_plan(*model, origin(), SphereGrid.full_sphere(30, 60), ids=ids))
    order, shown = plans[0].buffers[2][0].long(), int(plans[0].buffers[3][0])
    assert shown > 8192
    depth = means.double().norm(dim=1)[order[:shown]].to(dtype)
    away = depth.diff()
    assert (away >= -1e-6 * depth[1:]).all()
    for plan in plans[1:]:
        assert all(torch.equal(a, b) for a, b in zip(plan.buffers, plans[0].buffers, strict=True))


def test_calls_of_many_sizes_share_memory():
    """Borrowed memory holds what the call before left: a small scene after a large one is the same."""
    small, large = random_scene(n=20, seed=17), random_scene(n=400, seed=18)
    grid = SphereGrid.hemisphere(12, 48)
    first = [render(scene, poses(0), grid) for scene in (small, large)]
    again = [render(scene, poses(0), grid) for scene in (large, small)]
    for before, after in zip(first, reversed(again), strict=True):
        assert all(torch.equal(before[name], after[name]) for name in before)

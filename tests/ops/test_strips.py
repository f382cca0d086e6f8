"""What the walk over strips may skip unseen: tiles that are dark, columns no footprint reaches."""

from dataclasses import replace

import pytest
import torch
from compute_kernels import SETS, assert_threads_agree, instruction_set
from rasters import (
    PROJECTED,
    PROJECTIONS,
    assert_equals_reference,
    origin,
    poses,
    random_scene,
    render,
)

from gsparc.ops import SphereGrid, make_plan


def behind_a_wall():
    """More footprints than a batch holds, most of them where no light comes."""
    scene = random_scene(n=300, seed=12, size=2.0)
    return replace(scene, opacities=torch.where(scene.means[:, 0] > 0, 0.97, scene.opacities))


STEP = torch.pi / 24
CASES = {
    "dark and lit tiles": (behind_a_wall, poses(0), SphereGrid.hemisphere(15, 60)),
    "150 tiles across, more than two words have bits": (
        lambda: random_scene(n=40, seed=13, size=2.0),
        origin(),
        SphereGrid.hemisphere(6, 600),
    ),
    # Up to 64 strips pick their footprints; in a taller image each footprint is handed to its
    # strips. More ranks than a chunk.
    **{
        f"{height} rows": (
            lambda: random_scene(n=1100, samples=2, seed=15),
            poses(2),
            SphereGrid.hemisphere(height, 4),
        )
        for height in (256, 257)
    },
    **{
        f"{height} x {width}, which no tile divides": (
            lambda: random_scene(n=30, seed=14),
            poses(0),
            SphereGrid(height, width, -0.4, 2.9, 0.11, 0.07),
        )
        for height, width in ((1, 1), (3, 5), (5, 17), (4, 16), (7, 63))
    },
    "a row through the pole, whose tangent is infinite": (
        lambda: random_scene(n=60, seed=15, size=0.8),
        origin(),
        SphereGrid(13, 24, 0.0, -torch.pi, STEP, 2 * STEP),
    ),
}


@pytest.mark.parametrize(
    "case,projection",
    [
        (case, kind)
        for case in CASES
        for kind in PROJECTED
        if kind == "tangent" or " row" not in case
    ],
)
def test_equals_reference(case, projection):
    made, pose, grid = CASES[case]
    _, want = assert_equals_reference(made(), pose, grid, projection=projection)
    if made is behind_a_wall:
        assert (want["transmittance"] < 1e-4).double().mean() > 0.2
    if "pole" in case:
        assert want["image"][..., -1, :].abs().max() > 0.1


@SETS
@pytest.mark.parametrize("sizes", ["specks", "mixed", "needles"])
@PROJECTIONS
def test_spans_cut_no_pixel_off(name, sizes, projection):
    """Columns of a strip in closed form hold every pixel of the footprint: small or as wide as the
    sky, upright or leaning, over the seam and the poles, on whole and partial circles."""
    scene = random_scene(
        n=120, seed=19, size={"specks": 0.05, "mixed": 1.5, "needles": 0.05}[sizes]
    )
    if sizes == "needles":
        scene = replace(scene, scales=scene.scales * torch.tensor([60.0, 1.0, 0.02]))
    with instruction_set(name):
        for grid in (SphereGrid.full_sphere(40, 90), SphereGrid(21, 50, 0.1, 5.5, 0.03, 0.041)):
            assert_equals_reference(scene, poses(3), grid, projection=projection)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_thousands_are_ordered_alike_by_any_threads(dtype):
    """Enough visible Gaussians for the parts of the radix sort, some equally far:
    by (depth, id).
    """
    scene = random_scene(n=24_000, seed=16, size=0.02).to(dtype)
    means = torch.cat([scene.means[:12_000], -scene.means[:12_000]])  # the same distance twice
    ids = torch.randperm(24_000, generator=torch.Generator().manual_seed(3))
    model, grid = (
        (means, scene.quats, scene.scales, scene.opacities),
        SphereGrid.full_sphere(30, 60),
    )
    buffers = assert_threads_agree(lambda: list(make_plan(*model, origin(), grid, ids=ids).buffers))
    order, shown = buffers[2][0].long(), int(buffers[3][0])
    assert shown > 8192
    depth = means.double().norm(dim=1)[order[:shown]].to(dtype)
    assert (depth.diff() >= -1e-6 * depth[1:]).all()


def test_calls_of_many_sizes_share_memory():
    """Borrowed memory holds what the call before left:
    a small scene after a large one is the same.
    """
    small, large = random_scene(n=20, seed=17), random_scene(n=400, seed=18)
    grid = SphereGrid.hemisphere(12, 48)
    first = [render(scene, poses(0), grid) for scene in (small, large)]
    again = [render(scene, poses(0), grid) for scene in (large, small)]
    for before, after in zip(first, reversed(again), strict=True):
        assert all(torch.equal(before[name], after[name]) for name in before)

"""Inputs are refused in one line that says what to change; frozen views; the stages apart."""

import pytest
import torch
from rasters import GRIDS, poses, random_scene

from gsparc.ops import (
    BackendUnavailable,
    Cutoff,
    Optics,
    SphereGrid,
    StalePlan,
    composite,
    freeze,
    make_plan,
    rasterize,
)
from gsparc.ops.geometry import WIDEST_GRID

GRID = GRIDS["hemisphere"]


def parts(scene):
    return dict(means=scene.means, quats=scene.quats, scales=scene.scales, opacities=scene.opacities)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize(
    "change,error,words",
    [
        ({"quats": torch.zeros(4, 3, dtype=torch.float64)}, ValueError, r"quats must be \(4, 4\)"),
        ({"scales": torch.ones(4, 3)}, TypeError, "scales is torch.float32 but means is torch.float64"),
        ({"opacities": torch.full((4,), 1.5, dtype=torch.float64)}, ValueError, "Gaussian 0 has opacities"),
        ({"scales": torch.full((4, 3), -1.0, dtype=torch.float64)}, ValueError, "Gaussian 0 has scales"),
        ({"features": torch.zeros(5, 2, dtype=torch.float64)}, ValueError, "features must be"),
        ({"projection": "flat"}, ValueError, "'tangent' or 'equirect'"),
        ({"near": 0.0}, ValueError, "near > 0"),
        ({"ids": torch.arange(3)}, ValueError, "ids must be"),
    ],
)
def test_refusals(backend, change, error, words):
    scene = random_scene(n=4, samples=2)
    values = {**parts(scene), "features": scene.features, "backend": backend, **change}
    with pytest.raises(error, match=words) as caught:
        rasterize(pose=poses(0), grid=GRID, **values)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities"])
@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_poison_is_named(backend, name, poison):
    scene = random_scene(n=5)
    values = parts(scene)
    values[name] = values[name].clone()
    values[name][3] = poison
    with pytest.raises(ValueError, match=f"Gaussian 3 has {name}"):
        make_plan(**values, pose=poses(0), grid=GRID, backend=backend)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("name", ["opacities", "extinctions"])
def test_nobody_negative_hides_behind_the_larger(backend, name):
    """What emits and what hides are looked at both: only the larger was, and -1e30 went through."""
    scene = random_scene(n=5, hides=True)
    values = {**parts(scene), "extinctions": scene.extinctions}
    values[name] = values[name].clone()
    values[name][3] = -0.5
    with pytest.raises(ValueError, match=r"Gaussian 3 has opacities that are not in \[0, 1\]"):
        make_plan(**values, pose=poses(0), grid=GRID, backend=backend)


@pytest.mark.parametrize(
    "grid,words",
    [
        ((3, 4, float("nan"), 0.0, 0.2, 0.1), "finite angles"),
        ((3, 4, 0.0, float("inf"), 0.2, 0.1), "finite angles"),
        ((3, 4, 0.0, 0.0, 0.2, float("nan")), "finite angles"),
        ((3, 4, 1.4, 0.0, 0.2, 0.1), "elevations run from 1.4 to 1.8"),
        ((3, 4, -2.0, 0.0, 0.2, 0.1), "elevations run from -2"),
        ((1, 70_000, 0.0, 0.0, 0.1, 6.28 / 70_000), "at most 32767 columns"),
    ],
)
def test_grids_that_were_drawn_black(grid, words):
    """Blocks of columns are counted in 16 bits, and nothing is seen at NaN or beyond a pole."""
    with pytest.raises(ValueError, match=words):
        SphereGrid(*grid)


def test_the_widest_grid_is_drawn_to_its_last_column():
    scene, width = random_scene(n=20, samples=1), WIDEST_GRID
    grid = SphereGrid(1, width, 0.2, 0.0, 0.1, 2 * torch.pi / width)
    plans = [
        rasterize(**parts(scene), features=scene.features, pose=poses(0), grid=grid, backend=b)
        for b in ("cpu", "reference")
    ]
    assert (plans[0].image - plans[1].image).abs().max() < 1e-12 and plans[1].image.abs().max() > 0.01


def test_samples_and_poses_must_agree():
    scene = random_scene(n=4, samples=2)
    with pytest.raises(ValueError, match="2 samples need one pose or as many"):
        rasterize(**parts(scene), features=scene.features, pose=poses(3), grid=GRID)


def test_absent_backends_say_why():
    scene = random_scene(n=4)
    with pytest.raises(BackendUnavailable, match="CUDA"):
        make_plan(**parts(scene), pose=poses(0), grid=GRID, backend="cuda")
    with pytest.raises(ValueError, match="backend is"):
        make_plan(**parts(scene), pose=poses(0), grid=GRID, backend="tpu")


def test_bad_cutoffs_are_refused():
    with pytest.raises(ValueError, match="cut-offs"):
        Cutoff(alpha=0.0)
    with pytest.raises(ValueError, match="low_pass"):
        Optics(low_pass=-1.0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_stages_are_the_whole(backend):
    scene, pose = random_scene(), poses(3)
    plan = make_plan(**parts(scene), pose=pose, grid=GRID, backend=backend)
    apart = composite(plan, **parts(scene), features=scene.features)
    whole = rasterize(**parts(scene), features=scene.features, pose=pose, grid=GRID, backend=backend)
    assert torch.equal(apart.image, whole.image) and torch.equal(apart.radii, whole.radii)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_shared_features_many_poses(backend):
    scene, pose = random_scene(samples=1), poses(3)
    one = rasterize(**parts(scene), features=scene.features[0], pose=pose, grid=GRID, backend=backend)
    each = rasterize(
        **parts(scene), features=scene.features.expand(3, -1, -1), pose=pose, grid=GRID, backend=backend
    )
    assert one.image.shape == (3, 2, 30, 120) and torch.equal(one.image, each.image)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_frozen_view_renders_the_same(backend, dtype):
    scene, pose = random_scene(hides=True).to(dtype), poses(0)
    plan = make_plan(**parts(scene), pose=pose, grid=GRID, extinctions=scene.extinctions, backend=backend)
    frozen = freeze(plan, **parts(scene), extinctions=scene.extinctions, version=3)
    want = composite(plan, **parts(scene), features=scene.features, extinctions=scene.extinctions).image
    assert torch.allclose(frozen.render(scene.features, version=3), want, atol=1e-5)
    assert torch.allclose(frozen.render(scene.features[0], version=3), want[0], atol=1e-5)


@pytest.mark.parametrize("channels", [0, 1, 3, 19])
@pytest.mark.parametrize("samples", [1, 2])
def test_frozen_view_of_any_number_of_channels(channels, samples):
    """Few channels add neighbouring blocks apart, many all at once."""
    scene, pose = random_scene(n=300, channels=channels, samples=samples), poses(0)
    plan = make_plan(**parts(scene), pose=pose, grid=GRIDS["patch"])
    frozen = freeze(plan, **parts(scene), version=0)
    want = composite(plan, **parts(scene), features=scene.features).image
    assert torch.allclose(frozen.render(scene.features, version=0), want, rtol=0, atol=1e-12)
    assert torch.allclose(frozen.compose(scene.features[:, frozen.order]), want, rtol=0, atol=1e-12)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_frozen_view_of_features_that_are_too_few(backend):
    """The kernel picks the rows itself: it may not read beyond them."""
    scene = random_scene(n=60)
    plan = make_plan(**parts(scene), pose=poses(0), grid=GRID, backend=backend)
    frozen = freeze(plan, **parts(scene), version=0)
    with pytest.raises(ValueError, match=r"this view shows Gaussian \d+, got features of 5"):
        frozen.render(scene.features[:, :5], version=0)


def test_frozen_view_knows_when_it_is_stale():
    scene = random_scene()
    plan = make_plan(**parts(scene), pose=poses(0), grid=GRID)
    frozen = freeze(plan, **parts(scene), version=3)
    with pytest.raises(StalePlan, match="version 3, the field is at 4"):
        frozen.render(scene.features, version=4)
    with pytest.raises(ValueError, match="one pose"):
        freeze(make_plan(**parts(scene), pose=poses(2), grid=GRID), **parts(scene), version=0)


def test_plan_of_other_gaussians_is_refused():
    plan = make_plan(**parts(random_scene(n=4)), pose=poses(0), grid=GRID)
    scene = random_scene(n=5)
    with pytest.raises(ValueError, match="plan again"):
        composite(plan, **parts(scene), features=scene.features)

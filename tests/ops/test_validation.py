"""What no picture can be made of is refused at the rasterizer, on every backend that runs here."""

from __future__ import annotations

import pytest
import torch
from rasters import poses, random_scene
from torch.func import jacfwd, jacrev, vmap

from gsparc.ops import Pose, SphereGrid, UnsoundGaussian, freeze, make_plan, rasterize

GRID = SphereGrid.hemisphere(9, 18)
BACKENDS = pytest.mark.parametrize("backend", ["reference", "cpu"])


def drawn(backend, pose=None, ids=None, **change):
    scene = random_scene(n=6, samples=2)
    parts = {
        name: getattr(scene, name).clone() for name in ("means", "quats", "scales", "opacities", "features")
    }
    for name, (index, value) in change.items():
        parts[name][index] = value
    return rasterize(*parts.values(), poses(2) if pose is None else pose, GRID, ids=ids, backend=backend)


@BACKENDS
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_features_that_are_not_finite(backend, value):
    with pytest.raises(UnsoundGaussian, match="Gaussian 4 has features that are not finite") as refused:
        drawn(backend, features=((1, 4, 0), value))
    assert refused.value.index == 4


@BACKENDS
def test_features_of_a_frozen_view_were_not_looked_at(backend):
    scene = random_scene(n=40, samples=2)
    model = scene.model
    view = freeze(make_plan(*model, poses(1), GRID, backend=backend), *model, version=0)
    features = scene.features.clone()
    features[1, view.order[3], 0] = float("nan")
    found = f"Gaussian {int(view.order[3])} has features that are not finite"
    for draw in (lambda: view.render(features, 0), lambda: view.compose(features[:, view.order])):
        with pytest.raises(UnsoundGaussian, match=found):
            draw()
    view.render(torch.full_like(features, 1e308), 0)  # their sum is no number, each of them is
    with pytest.raises(TypeError, match=r"features are torch.float32, this view was frozen in torch.float64"):
        view.render(scene.features.float(), 0)
    with pytest.raises(ValueError, match=r"of those seen, got \(2, 1, 2\)"):
        view.compose(features[:, :1])  # the kernel read beyond them


@BACKENDS
def test_features_under_transforms_were_not_looked_at(backend):
    scene = random_scene(n=6, samples=2)
    features = scene.features.clone()
    features[1, 4, 0] = float("inf")
    pose = poses(1)

    def drawn_of(values):
        model = scene.model
        return rasterize(*model, values, pose, GRID, backend=backend).image

    mapped_last = lambda values: vmap(drawn_of, in_dims=2)(values.movedim(0, 2))  # noqa: E731
    for made in (vmap(drawn_of), mapped_last, jacfwd(drawn_of), jacrev(lambda v: vmap(drawn_of)(v).sum())):
        with pytest.raises(UnsoundGaussian, match="Gaussian 4 has features that are not finite"):
            made(features)


@BACKENDS
@pytest.mark.parametrize("far", [2e6, 1e30, float("nan")])
def test_a_pose_far_away(backend, far):
    pose = poses(2)
    pose.position[1, 2] = far
    with pytest.raises(ValueError, match=r"pose 1 is not finite, not within 1e\+06 m, or its matrix is no"):
        drawn(backend, pose)


@BACKENDS
@pytest.mark.parametrize("wrong", ["zero", "twice", "mirrored", "sheared", "a column twice"])
def test_a_pose_that_is_no_rotation(backend, wrong):
    rotation = poses(2).rotation
    drawn(backend, Pose(poses(2).position, rotation + 5e-4))  # the rounding of a file written by hand
    matrix = {
        "zero": torch.zeros(3, 3),
        "twice": 2 * torch.eye(3),
        "mirrored": torch.diag(torch.tensor([1.0, 1, -1])),
        "sheared": torch.eye(3) + torch.tensor([[0, 0.01, 0], [0, 0, 0], [0, 0, 0]]),
        "a column twice": torch.tensor([[1.0, 1, 0], [0, 0, 0], [0, 0, 1]]),
    }[wrong]
    with pytest.raises(ValueError, match="its matrix is no rotation"):
        drawn(backend, Pose(poses(2).position, torch.stack([rotation[0], matrix.to(rotation)])))


@BACKENDS
def test_the_pose_that_is_none_was_not_named(backend):
    scene, many = random_scene(n=6, samples=1), poses(300)
    many.rotation[217] *= -1
    with pytest.raises(ValueError, match="pose 217 is not finite"):
        make_plan(*scene.model, many, GRID, backend=backend)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize(("size", "sound"), [(0.95e-3, True), (0.99e-3, False)])
def test_backends_disagreed_on_what_a_rotation_is(backend, size, sound):
    """The products of its columns are within SKEW, their cross product is not: the reference took it."""
    strain = size * torch.tensor([[-1.0, 1, 1], [1, 1, 1], [1, 1, 1]], dtype=torch.float64)
    across = torch.tensor([3.0, -2, -2], dtype=torch.float64)  # of which the first row's error is a multiple
    turn = torch.linalg.qr(torch.column_stack([across, torch.eye(3, dtype=torch.float64)[:, :2]]))[0].mT
    turn[2] *= torch.linalg.det(turn)
    pose = Pose(poses(1).position, (turn @ (torch.eye(3) + strain))[None])
    assert ((pose.rotation.mT @ pose.rotation - torch.eye(3)).abs() < 2e-3).all()
    if sound:
        drawn(backend, pose)
    else:
        with pytest.raises(ValueError, match="its matrix is no rotation"):
            drawn(backend, pose)


@BACKENDS
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64, torch.complex64], ids=str)
def test_a_pose_in_half_precision_was_one_or_none_by_its_rounding(backend, dtype):
    pose = poses(2)
    for wrong in (Pose(pose.position, pose.rotation.to(dtype)), Pose(pose.position.to(dtype), pose.rotation)):
        with pytest.raises(TypeError, match=r"a pose needs float32 or float64, got a (position|rotation) in"):
            drawn(backend, wrong)


@BACKENDS
def test_equal_ids_at_one_place_have_no_order(backend):
    """The picture depended on the order of the rows."""
    scene = random_scene(n=6, samples=2)
    twin = {"means": (3, scene.means[2])}
    ids = torch.tensor([0, 1, 2, 3, 4, 5])
    drawn(backend, ids=ids, **twin)
    for order in (slice(None), torch.tensor([5, 4, 3, 2, 1, 0])):
        twice = ids.clone()
        twice[3] = 2
        drawn(backend, ids=twice)  # at different distances they do have one
        with pytest.raises(ValueError, match="Gaussians at one distance have equal ids"):
            drawn(backend, ids=twice[order] if isinstance(order, slice) else (7 - twice), **twin)

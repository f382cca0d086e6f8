"""What no picture can be made of is refused in one line, on every backend that runs here."""

import math

import pytest
import torch
from rasters import poses, random_scene
from refusals import refused
from torch.func import jacfwd, jacrev, vmap

from gsparc.ops import (
    Cutoff,
    Optics,
    Pose,
    SphereGrid,
    UnsoundGaussian,
    composite,
    freeze,
    make_plan,
    rasterize,
)

GRID = SphereGrid.hemisphere(9, 18)
BACKENDS = pytest.mark.parametrize("backend", ["reference", "cpu"])
NAMES = ("means", "quats", "scales", "opacities", "features")
PLACE, TURN = poses(2).position, poses(2).rotation


def drawn(backend, apart=False, **change):
    """In one call, or in two."""
    scene = random_scene(n=6, samples=2)
    given = (
        {name: getattr(scene, name) for name in NAMES}
        | {"pose": poses(2), "backend": backend}
        | change
    )
    if not apart:
        return rasterize(**given, grid=GRID)
    features = given.pop("features")
    plan = make_plan(**given, grid=GRID)
    return composite(plan, *(given[name] for name in NAMES[:4]), features)


def wrong(name, index, value):
    """One number of an input replaced."""
    tensor = getattr(random_scene(n=6, samples=2), name).clone()
    tensor[index] = value
    return {name: tensor}


def posed(far=None, matrix=None):
    """The second pose with another height [m], or with another matrix for a rotation."""
    place, turn = PLACE.clone(), TURN.clone()
    if far is not None:
        place[1, 2] = far
    if matrix is not None:
        turn[1] = torch.tensor(matrix)
    return {"pose": Pose(place, turn)}


NO_POSE = r"pose 1 is not finite, not within 1e\+06 m, or its matrix is no rotation"
HALF = r"a pose needs float32 or float64, got a (position|rotation) in"
REFUSED = [
    ({"quats": torch.zeros(6, 3).double()}, ValueError, r"quats must be \(6, 4\)"),
    ({"scales": torch.ones(6, 3)}, TypeError, "scales is torch.float32 but means is torch.float64"),
    ({"features": torch.zeros(7, 2).double()}, ValueError, "features must be"),
    ({"ids": torch.arange(3)}, ValueError, "ids must be"),
    ({"projection": "flat"}, ValueError, "'tangent' or 'equirect'"),
    ({"near": 0.0}, ValueError, "near > 0"),
    ({"pose": poses(3)}, ValueError, "2 samples need one pose or as many"),
    (wrong("opacities", 0, 1.5), UnsoundGaussian, "Gaussian 0 has opacities"),
    (wrong("scales", 0, -1.0), UnsoundGaussian, "Gaussian 0 has scales"),
    *(
        (wrong(name, 3, value), UnsoundGaussian, f"Gaussian 3 has {name}")
        for name in NAMES[:4]
        for value in (math.nan, math.inf)
    ),
    *(
        (
            wrong("features", (1, 4, 0), value),
            UnsoundGaussian,
            "Gaussian 4 has features that are not finite",
        )
        for value in (math.nan, math.inf)
    ),
    (
        wrong("opacities", 3, -0.5),
        UnsoundGaussian,
        r"Gaussian 3 has opacities that are not in \[0, 1\]",
    ),
    *((posed(far=far), ValueError, NO_POSE) for far in (2e6, 1e30, math.nan)),
    *(
        (posed(matrix=matrix), ValueError, NO_POSE)
        for matrix in (
            [[0.0] * 3] * 3,
            [[2.0, 0, 0], [0, 2, 0], [0, 0, 2]],
            [[1.0, 0, 0], [0, 1, 0], [0, 0, -1]],
            [[1.0, 0.01, 0], [0, 1, 0], [0, 0, 1]],
            [[1.0, 1, 0], [0, 0, 0], [0, 0, 1]],
        )
    ),
    *(
        ({"pose": pose}, TypeError, HALF)
        for dtype in (torch.float16, torch.bfloat16, torch.int64, torch.complex64)
        for pose in (Pose(PLACE, TURN.to(dtype)), Pose(PLACE.to(dtype), TURN))
    ),
]


def short_id(value):
    return value if isinstance(value, str) else ""


@BACKENDS
@pytest.mark.parametrize("change,error,words", REFUSED, ids=short_id)
def test_refusals(backend, change, error, words):
    with pytest.raises(error, match=words) as refused:
        drawn(backend, **change)
    with pytest.raises(error) as again:
        drawn(backend, apart=True, **change)
    assert again.type is refused.type and str(again.value) == str(refused.value)
    assert "\n" not in str(again.value)
    if error is UnsoundGaussian:
        assert f"Gaussian {refused.value.index} " in str(refused.value)


@pytest.mark.parametrize(
    "grid,words",
    [
        ((3, 4, math.nan, 0.0, 0.2, 0.1), "finite angles"),
        ((3, 4, 0.0, math.inf, 0.2, 0.1), "finite angles"),
        ((3, 4, 0.0, 0.0, 0.2, math.nan), "finite angles"),
        ((3, 4, 1.4, 0.0, 0.2, 0.1), "elevations run from 1.4 to 1.8"),
        ((3, 4, -2.0, 0.0, 0.2, 0.1), "elevations run from -2"),
        ((1, 70_000, 0.0, 0.0, 0.1, 6.28 / 70_000), "at most 32767 columns"),
    ],
)
def test_grids_that_were_drawn_black(grid, words):
    """Blocks of columns are counted in 16 bits, and nothing is seen at NaN or beyond a pole."""
    refused(words, SphereGrid, *grid)


def test_bad_cutoffs():
    refused("cut-offs", Cutoff, alpha=0.0)
    refused("low_pass", Optics, low_pass=-1.0)


@BACKENDS
def test_features_of_a_frozen_view_were_not_looked_at(backend):
    scene = random_scene(n=40, samples=2)
    view = freeze(make_plan(*scene.model, poses(1), GRID, backend=backend), *scene.model, version=0)
    features = scene.features.clone()
    features[1, view.order[3], 0] = math.nan
    words = f"Gaussian {int(view.order[3])} has features that are not finite"
    for draw in (
        lambda: view.render(features, 0),
        lambda: view.render_visible(features[:, view.order]),
    ):
        with pytest.raises(UnsoundGaussian, match=words):
            draw()
    view.render(torch.full_like(features, 1e308), 0)  # their sum is no number, each of them is
    for values, draw, error, words in (
        (
            features.float(),
            view.render,
            TypeError,
            "are torch.float32, this view was frozen in torch.float64",
        ),
        (
            features[:, :5],
            view.render,
            ValueError,
            r"this view shows Gaussian \d+, got features of 5",
        ),
        (features[:, :1], view.render_visible, ValueError, r"of those seen, got \(2, 1, 2\)"),
    ):  # the kernel picks the rows itself: it may not read beyond them
        with pytest.raises(error, match=words):
            draw(values, *([0] if draw == view.render else []))


@BACKENDS
def test_features_under_transforms_were_not_looked_at(backend):
    scene = random_scene(n=6, samples=2)
    features = scene.features.clone()
    features[1, 4, 0] = math.inf
    pose = poses(1)

    def drawn_of(values):
        return rasterize(*scene.model, values, pose, GRID, backend=backend).image

    mapped_last = lambda values: vmap(drawn_of, in_dims=2)(values.movedim(0, 2))  # noqa: E731
    for made in (
        vmap(drawn_of),
        mapped_last,
        jacfwd(drawn_of),
        jacrev(lambda v: vmap(drawn_of)(v).sum()),
    ):
        with pytest.raises(UnsoundGaussian, match="Gaussian 4 has features that are not finite"):
            made(features)


@BACKENDS
def test_the_pose_that_is_none_was_not_named(backend):
    scene, many = random_scene(n=6, samples=1), poses(300)
    many.rotation[217] *= -1
    refused("pose 217 is not finite", make_plan, *scene.model, many, GRID, backend=backend)


@BACKENDS
@pytest.mark.parametrize("size,sound", [(0.95e-3, True), (0.99e-3, False)])
def test_backends_disagreed_on_what_a_rotation_is(backend, size, sound):
    """The products of its columns are within SKEW, their cross product is not:
    the reference took it.
    """
    strain = size * torch.tensor([[-1.0, 1, 1], [1, 1, 1], [1, 1, 1]], dtype=torch.float64)
    # Of which the first row's error is a multiple
    across = torch.tensor([3.0, -2, -2], dtype=torch.float64)
    turn = torch.linalg.qr(torch.column_stack([across, torch.eye(3, dtype=torch.float64)[:, :2]]))[
        0
    ].mT
    turn[2] *= torch.linalg.det(turn)
    pose = Pose(poses(1).position, (turn @ (torch.eye(3) + strain))[None])
    assert ((pose.rotation.mT @ pose.rotation - torch.eye(3)).abs() < 2e-3).all()
    if sound:
        drawn(backend, pose=pose)
        drawn(backend, pose=Pose(PLACE, TURN + 5e-4))  # the rounding of a file written by hand
    else:
        refused("its matrix is no rotation", drawn, backend, pose=pose)


@BACKENDS
def test_equal_ids_at_one_place_have_no_order(backend):
    """The picture depended on the order of the rows."""
    twin, ids = wrong("means", 3, random_scene(n=6, samples=2).means[2]), torch.arange(6)
    twice = torch.tensor([0, 1, 2, 2, 4, 5])
    drawn(backend, ids=ids, **twin)
    drawn(backend, ids=twice)  # at different distances they do have one
    for order in (twice, 7 - twice):
        for apart in (False, True):
            refused(
                "Gaussians at one distance have equal ids", drawn, backend, apart, ids=order, **twin
            )

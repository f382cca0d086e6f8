"""Forward mode, second derivatives and `torch.func` over the rasterizer: right,
or refused in words.
"""

from dataclasses import replace

import pytest
import torch
from rasters import poses, random_scene
from refusals import refused
from torch.autograd import forward_ad
from torch.func import hessian, jacfwd, jacrev, jvp, vjp, vmap

from gsparc.ops import (
    Cutoff,
    Pose,
    SphereGrid,
    composite,
    freeze,
    make_plan,
    mean_weights,
    rasterize,
)

GRID = SphereGrid.hemisphere(9, 18)
POSE = Pose.identity(torch.zeros(3, dtype=torch.float64))
BACKENDS = pytest.mark.parametrize("backend", ["reference", "cpu"])


def field():
    """Parameters of six Gaussians, without a fixture: other backends run these tests too."""
    scene = random_scene(n=6, samples=1)
    parts = (scene.means, scene.quats, scene.scales, scene.opacities, scene.features[0])
    return tuple(part.double() for part in parts)


def image(backend):
    return lambda *model: rasterize(*model, POSE, GRID, backend=backend).image


def shares(backend):
    return lambda *model: (
        mean_weights(make_plan(*model[:4], POSE, GRID, backend=backend), *model[:4]).share
    )


def tangents(values):
    draw = torch.Generator().manual_seed(1)
    return tuple(torch.randn(value.shape, generator=draw, dtype=torch.float64) for value in values)


@BACKENDS
@pytest.mark.parametrize("made", [image, shares], ids=["image", "share"])
def test_forward_mode_was_zero_in_silence(made, backend):
    """By the kernels 0; by the reference the footprints' motion counted twice."""
    model = field()
    function, directions = made(backend), tangents(model)
    found = jvp(function, model, directions)[1]
    step = 1e-6
    ahead, behind = (
        function(*(v + sign * step * d for v, d in zip(model, directions, strict=True)))
        for sign in (1, -1)
    )
    assert found.abs().max() > 1e-3
    assert torch.allclose(
        found, (ahead - behind) / (2 * step), atol=1e-5 * float(found.abs().max())
    )
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(v, d) for v, d in zip(model, directions, strict=True)]
        assert torch.allclose(forward_ad.unpack_dual(function(*duals)).tangent, found, rtol=1e-12)


@BACKENDS
@pytest.mark.parametrize("opacity", [1e-28, 1e-31, 1e-36])
def test_the_share_of_the_faintest_had_a_tangent_and_no_gradient(backend, opacity):
    """Below FAINTEST it has neither."""
    means, quats, scales, opacities, _ = field()
    faint, origin = opacities.clone(), Pose.identity(torch.zeros(3, dtype=torch.float64))
    seen = shares(backend)(means, quats, scales, opacities)[0]
    last = torch.where(seen > 0, seen, 1).argmin()  # which the others hide a part of
    faint[last] = opacity

    def share(means):
        cutoff = Cutoff(0.01, 0.0, relative=True)
        plan = make_plan(means, quats, scales, faint, origin, GRID, backend=backend, cutoff=cutoff)
        return mean_weights(plan, means, quats, scales, faint).share[:, last]

    tangent = jvp(share, (means,), (torch.ones_like(means),))[1].sum()
    leaf = means.clone().requires_grad_()
    share(leaf).sum().backward()
    assert torch.allclose(tangent, leaf.grad.sum(), rtol=1e-9, atol=0)
    assert bool(tangent != 0) == (opacity > 1e-30)


@BACKENDS
@pytest.mark.parametrize("derived", [False, True], ids=["backward", "forward"])
def test_no_poses_made_an_empty_image_or_an_error_of_a_library(backend, derived):
    model = [part.clone().requires_grad_() for part in field()]
    none, features = poses(1)[:0], torch.zeros(0, 6, 2, dtype=torch.float64)

    def drawn(means):
        plan = make_plan(means, *model[1:4], none, GRID, backend=backend)
        raster = composite(plan, means, *model[1:4], features)
        assert plan.radii.shape == plan.visible.shape == (0, 6) and plan.means2d.shape == (0, 6, 2)
        return raster.image, raster.transmittance, mean_weights(plan, means, *model[1:4]).share

    outputs = jvp(drawn, (field()[0],), (field()[0],))[1] if derived else drawn(model[0])
    assert [tuple(part.shape) for part in outputs] == [(0, 2, 9, 18), (0, 9, 18), (0, 6)]
    if not derived:
        sum(part.sum() for part in outputs).backward()
        assert all(leaf.grad is not None and not leaf.grad.any() for leaf in model[:4])


@BACKENDS
def test_transforms_agree_with_autograd(backend):
    model = field()
    slope = tangents((image(backend)(*model),))[0]
    leaves = [part.clone().requires_grad_() for part in model]
    wanted = torch.autograd.grad(image(backend)(*leaves), leaves, slope)
    found = vjp(image(backend), *model)[1](slope)
    for one, other in zip(found, wanted, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-10)

    def power(means):
        return image(backend)(means, *model[1:]).square().sum((0, 2, 3))

    assert torch.allclose(jacrev(power)(model[0]), jacfwd(power)(model[0]), rtol=1e-9, atol=1e-10)


@BACKENDS
def test_a_batch_of_features_may_be_mapped(backend):
    model = field()
    features = torch.stack([model[4], 2 * model[4]])
    found = vmap(lambda values: image(backend)(*model[:4], values))(features)
    assert torch.allclose(found[1], 2 * found[0]) and torch.allclose(
        found[0], image(backend)(*model)
    )


@BACKENDS
def test_gaussians_mapped_over_a_plan_got_past_the_refusal(backend):
    """Each was drawn by the order and the cut-offs of the first."""
    model = field()
    plan = make_plan(*model[:4], POSE, GRID, backend=backend)
    several = torch.stack([model[0], -model[0]])
    for made in (
        lambda means: image(backend)(means, *model[1:]),
        lambda means: composite(plan, means, *model[1:]).image,
        lambda means: mean_weights(plan, means, *model[1:4]).share,
        lambda means: freeze(plan, means, *model[1:4], version=0).render(model[4], 0),
    ):
        refused(r"vmap over Gaussians or poses is not possible: give P poses", vmap(made), several)


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
def test_the_hessian_in_means_was_off_by_five_percent(projection):
    """The frame of `tangent` was orthonormal to first order only."""
    model = field()
    weight = tangents((image("cpu")(*model),))[0]

    def power(backend):
        cutoff = Cutoff(1e-12, 0.0)  # no edge that a difference could cross
        return lambda means: (
            rasterize(
                means, *model[1:], POSE, GRID, projection=projection, cutoff=cutoff, backend=backend
            ).image
            * weight
        ).sum()

    def slope(means, backend="cpu", **kept):
        leaf = means.clone().requires_grad_()
        return leaf, torch.autograd.grad(power(backend)(leaf), leaf, **kept)[0].flatten()

    step, directions = (
        1e-5,
        torch.eye(model[0].numel(), dtype=torch.float64).unflatten(-1, model[0].shape),
    )
    ends = ([slope(model[0] + sign * step * d)[1] for d in directions] for sign in (1, -1))
    wanted = torch.stack(
        [(ahead - behind) / (2 * step) for ahead, behind in zip(*ends, strict=True)]
    )
    leaf, kept = slope(model[0], "reference", create_graph=True)
    rows = torch.stack(
        [torch.autograd.grad(part, leaf, retain_graph=True)[0].flatten() for part in kept]
    )
    for found in (rows, hessian(power("cpu"))(model[0]).reshape(wanted.shape)):
        assert (found - wanted).abs().max() < 1e-6 * wanted.abs().max()


@BACKENDS
@pytest.mark.parametrize("part", ["position", "rotation"])
def test_a_pose_had_no_gradient_and_no_word(backend, part):
    """Nor one that was planned without gradients."""
    model = [part.clone().requires_grad_() for part in field()]
    pose = replace(POSE, **{part: getattr(POSE, part).clone().requires_grad_()})
    with torch.no_grad():
        rasterize(*model, pose, GRID, backend=backend)
        plan = make_plan(*model[:4], pose, GRID, backend=backend)
        composite(plan, *model)
    for made in (
        lambda: rasterize(*field(), pose, GRID, backend=backend),
        lambda: composite(plan, *model),
        lambda: mean_weights(plan, *model[:4]),
    ):
        refused("a pose has no gradients here: detach it", made)


@BACKENDS
@pytest.mark.parametrize("precision", [torch.bfloat16, torch.float16], ids=str)
def test_autocast_lowered_the_precision_in_silence(backend, precision):
    """The reference and forward mode drew in half precision and refused sound rotations."""
    model = [part.float() for part in field()]
    pose = poses(1)
    drawn = lambda means: rasterize(means, *model[1:], pose, GRID, backend=backend).image  # noqa: E731
    wanted = jvp(drawn, (model[0],), (model[0],))
    with torch.autocast("cpu", dtype=precision):
        image, found = drawn(model[0]), jvp(drawn, (model[0],), (model[0],))
    assert torch.allclose(image, wanted[0], atol=1e-5)
    for part, whole in zip(found, wanted, strict=True):
        assert torch.allclose(part, whole, rtol=1e-5, atol=1e-5 * float(whole.abs().max()))


@BACKENDS
def test_a_plan_of_inference_mode_was_trained_in_the_words_of_a_library(backend):
    model = [part.clone().requires_grad_() for part in field()]
    with torch.inference_mode():
        plan = make_plan(*model[:4], POSE, GRID, backend=backend)
    for made in (lambda: composite(plan, *model), lambda: mean_weights(plan, *model[:4])):
        with pytest.raises(RuntimeError, match=r"this plan was made in torch.inference_mode"):
            made()
    with torch.no_grad():
        assert composite(plan, *model).image.isfinite().all()


@BACKENDS
def test_a_frozen_view_was_a_constant_to_transforms(backend):
    """Gradients were zero or failed in torch's words, tangents were dropped in silence."""
    model = field()
    plan = make_plan(*model[:4], POSE, GRID, backend=backend)
    view = freeze(plan, *model[:4], version=0)
    asked = (
        lambda made, value: vjp(made, value)[1](made(value)),
        lambda made, value: jvp(made, (value,), (value,)),
        lambda made, value: jacrev(made)(value),
        lambda made, value: jacfwd(made)(value),
    )
    for derivative in asked:
        with pytest.raises(
            RuntimeError, match="a frozen view has no derivatives and cannot be mapped"
        ):
            derivative(lambda features: view.render(features, 0), model[4])
        with pytest.raises(
            RuntimeError, match="a frozen view has no derivatives: composite the plan"
        ):
            derivative(
                lambda opacities: freeze(plan, *model[:3], opacities, version=0).order, model[3]
            )
    with pytest.raises(RuntimeError, match="cannot be mapped"):
        vmap(lambda features: view.render(features, 0))(torch.stack([model[4], model[4]]))
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(model[3], model[3])
        with pytest.raises(RuntimeError, match="a frozen view has no derivatives"):
            freeze(plan, *model[:3], dual, version=0)

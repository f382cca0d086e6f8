"""Nobody there: no Gaussians, all culled, all transparent.

Remedy: empty plans are plans (csrc/plan.cpp); outputs and gradients are defined: zeros,
transmittance 1. Exact: nothing is computed that could round.
"""

from dataclasses import replace

import pytest
import torch
from rasters import PROJECTIONS, origin, poses, random_scene, render

from gsparc.ops import Cutoff, SphereGrid, freeze, make_plan, mean_weights

GRID = SphereGrid.hemisphere(10, 20)


def assert_nothing_is_seen(got):
    assert (
        (got["image"] == 0).all() and (got["transmittance"] == 1).all() and not got["visible"].any()
    )
    assert all((value == 0).all() for name, value in got.items() if name.startswith("d_"))


@PROJECTIONS
@pytest.mark.parametrize("count", [0, 3])
def test_no_gaussians(backend, projection, count):
    scene = random_scene(n=0)
    got = render(scene, poses(count), GRID, backend, projection=projection)
    assert got["image"].shape == (3, 2, 10, 20) and got["d_means"].shape == (0, 3)
    assert_nothing_is_seen(got)


def below_the_horizon():
    scene = random_scene(n=20, size=0.1)
    return replace(scene, means=scene.means * 0.1 - torch.tensor([0.0, 0.0, 5.0]).double())


def test_all_below_the_horizon(backend):
    assert_nothing_is_seen(render(below_the_horizon(), origin(), GRID, backend))


@pytest.mark.parametrize("relative", [False, True])
def test_all_transparent(backend, relative):
    scene = replace(random_scene(n=20), opacities=torch.zeros(20).double())
    assert_nothing_is_seen(render(scene, origin(), GRID, backend, cutoff=Cutoff(relative=relative)))


def test_weights_and_frozen_views_of_nothing(backend):
    scene = random_scene(n=0)
    model = [leaf.requires_grad_() for leaf in scene.model]
    plan = make_plan(*model, origin(), GRID, backend=backend)
    seen = mean_weights(plan, *model)
    assert seen.mean.shape == (1, 0) == seen.share.shape
    image = freeze(plan, *model, version=0).render(torch.zeros(0, 2).double(), version=0)
    assert image.shape == (2, 10, 20) and (image == 0).all()


def test_share_of_the_unseen_is_zero_and_harmless(backend):
    model = below_the_horizon().model
    model[3].requires_grad_()
    seen = mean_weights(make_plan(*model, origin(), GRID, backend=backend), *model)
    (seen.share.sum() + seen.mean.sum()).backward()
    assert (seen.share == 0).all() and (model[3].grad == 0).all()

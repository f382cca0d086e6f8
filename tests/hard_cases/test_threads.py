"""Threads: sums depend on how the work was divided.

Remedy: strips leave their sums in slots of their own, added per Gaussian in strip order (csrc/backward.h); no
atomics. Shown: 1 thread = 2 = 5 threads, bit for bit.
"""

import multiprocessing

import numpy as np
import pytest
import torch
from rasters import poses, random_scene, render

from gsparc.ops import SphereGrid, freeze, make_plan, mean_weights, rasterize

GRID = SphereGrid.hemisphere()


@pytest.fixture(autouse=True)
def _restore_threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("projection", ["tangent", "equirect"])
@pytest.mark.parametrize("count", [0, 3])
def test_bit_identical(dtype, projection, count):
    scene = random_scene(n=700, seed=1, hides=True).to(dtype)
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        results.append(render(scene, poses(count), GRID, projection=projection, behind=False))
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value, other[name]), name


def test_weights_are_bit_identical():
    scene = random_scene(n=700, seed=1).to(torch.float32)
    results = []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        model = [
            getattr(scene, k).clone().requires_grad_() for k in ("means", "quats", "scales", "opacities")
        ]
        plan = make_plan(*model, poses(2), GRID)
        seen = mean_weights(plan, *model)
        (seen.mean * torch.arange(700.0)).sum().backward()
        results.append([seen.mean, seen.share, *(leaf.grad for leaf in model)])
        with torch.no_grad():
            view = freeze(make_plan(*model, poses(0), GRID), *model, version=0)
            results[-1].append(view.render(scene.features, version=0))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_adding_in_another_order_breaks():
    """Naive: whoever finishes first adds first. Float addition does not commute with that."""
    draw = np.random.default_rng(0)
    terms = draw.normal(size=10_000).astype(np.float32)
    sums = {float(np.add.accumulate(draw.permutation(terms))[-1]) for _ in range(5)}
    assert len(sums) > 1


POSE = poses(0)


def _total(inputs) -> float:
    return float(rasterize(*inputs, POSE, GRID).image.numpy().sum())


def test_a_forked_child_can_render():
    """Forked workers inherit a pool without its threads; they must make their own.

    The child calls nothing of torch's that uses OpenMP: libgomp does not survive a fork.
    """
    torch.set_num_threads(2)
    scene = random_scene(n=50)
    inputs = (scene.means, scene.quats, scene.scales, scene.opacities, scene.features)
    want = _total(inputs)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=lambda: queue.put(_total(inputs)))
    child.start()
    try:
        assert queue.get(timeout=20) == want
    finally:
        child.kill()
        child.join()

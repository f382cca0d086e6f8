"""Threads: sums depend on how the work was divided.

Remedy: strips leave their sums in slots of their own, added per Gaussian in strip order
(csrc/backward.h); no atomics. Shown: 1 thread = 2 = 5 threads, bit for bit.
"""

import multiprocessing

import pytest
import torch
from compute_kernels import assert_threads_agree
from rasters import PROJECTIONS, poses, random_scene, render

from gsparc.ops import SphereGrid, freeze, make_plan, mean_weights, rasterize

GRID = SphereGrid.hemisphere()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@PROJECTIONS
@pytest.mark.parametrize("count", [0, 3])
def test_bit_identical(dtype, projection, count):
    scene = random_scene(n=700, seed=1).to(dtype)
    optics = {"projection": projection, "behind": False}
    assert_threads_agree(lambda: list(render(scene, poses(count), GRID, **optics).values()))


def test_weights_are_bit_identical():
    scene = random_scene(n=700, seed=1).to(torch.float32)

    def call():
        model = [leaf.clone().requires_grad_() for leaf in scene.model]
        seen = mean_weights(make_plan(*model, poses(2), GRID), *model)
        (seen.mean * torch.arange(700.0)).sum().backward()
        with torch.no_grad():
            view = freeze(make_plan(*model, poses(0), GRID), *model, version=0)
            image = view.render(scene.features, version=0)
        return [seen.mean, seen.share, *(leaf.grad for leaf in model), image]

    assert_threads_agree(call)


POSE = poses(0)


def _total(inputs) -> float:
    return float(rasterize(*inputs, POSE, GRID).image.numpy().sum())


def test_a_forked_child_can_render():
    """Forked workers inherit a pool without its threads; they must make their own.

    The child calls nothing of torch's that uses OpenMP: libgomp does not survive a fork.
    """
    scene, before = random_scene(n=50), torch.get_num_threads()
    torch.set_num_threads(2)
    inputs = (*scene.model, scene.features)
    want = _total(inputs)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=lambda: queue.put(_total(inputs)))
    child.start()
    try:
        assert queue.get(timeout=20) == want
    finally:
        torch.set_num_threads(before)
        child.kill()
        child.join()

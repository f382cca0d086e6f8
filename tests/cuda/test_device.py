"""On a GPU: tensors that live there, streams, captured graphs, repeatability, and the model."""

import pytest
import torch
from rasters import GRIDS, TOLERANCES, assert_close, poses, random_scene, render

from gsparc.ops import Pose, cuda_library, freeze, make_plan, mean_weights, rasterize

REASON = cuda_library.missing_device()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))
GRID = GRIDS["hemisphere"]


def there(count: int = 0, n: int = 60, **kind):
    """A scene, its Gaussians as `rasterize` takes them, and poses, all on the GPU in float32."""
    scene = random_scene(n=n, **kind).to(torch.float32)
    scene = scene.on("cuda")
    return scene, scene.model, poses(count).to("cuda")


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tensors_on_the_gpu_go_through_its_kernels(projection, count, dtype):
    scene = random_scene(seed=count)
    want = render(scene, poses(count), GRID, "reference", projection=projection)
    moved = scene.to(dtype).on("cuda")
    got = render(moved, poses(count).to("cuda"), GRID, "cuda", projection=projection)
    assert got["image"].is_cuda
    assert_close({name: value.cpu() for name, value in got.items()}, want, TOLERANCES[dtype])


def test_twice_is_bit_identical():
    scene, model, pose = there(3, n=2000)
    runs = []
    for _ in range(2):
        leaves = [tensor.clone().requires_grad_() for tensor in (*model, scene.features)]
        raster = rasterize(*leaves, pose, GRID)
        (raster.image.square().sum() + raster.transmittance.sum()).backward()
        runs.append([raster.image, *(leaf.grad for leaf in leaves)])
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


def test_work_is_on_the_current_stream():
    """A slow product is queued first; the raster reads what it makes, on the same side stream."""
    scene, model, pose = there()
    want = rasterize(*model, scene.features, pose, GRID).image
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        big = torch.randn(4096, 4096, device="cuda")
        for _ in range(20):
            big = (big @ big).clamp(-1, 1)
        features = scene.features + 0 * big.sum()
        got = rasterize(*model, features, pose, GRID).image
    side.synchronize()
    assert torch.equal(got, want)


def captured(function):
    """`function` as a replayable graph, warmed up; returns the graph and its outputs."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side), torch.no_grad():
        for _ in range(2):
            function()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph), torch.no_grad():
        outputs = function()
    return graph, outputs


def test_a_query_can_be_captured():
    scene, model, pose = there(1)
    query = scene.features[:1].clone()
    graph, image = captured(lambda: rasterize(*model, query, pose, GRID).image)
    for seed in range(3):
        query.copy_(torch.randn(query.shape, generator=torch.Generator().manual_seed(seed)))
        pose.position.copy_(0.1 * seed * torch.ones(1, 3))
        graph.replay()
        want = rasterize(*model, query, Pose(pose.position.clone(), pose.rotation), GRID).image
        assert torch.equal(image, want), seed


def test_weights_and_frozen_views_can_be_captured():
    scene, model, pose = there()
    weigh = lambda: mean_weights(make_plan(*model, pose, GRID), *model).share  # noqa: E731
    graph, share = captured(weigh)
    graph.replay()
    assert torch.equal(share, weigh())
    view = freeze(make_plan(*model, pose, GRID), *model, version=0)
    for query in (scene.features, scene.features[0], torch.randn(40, 60, 1, device="cuda")):
        graph, image = captured(lambda query=query: view.render(query, version=0))
        graph.replay()
        want = rasterize(*model, query, pose, GRID).image
        assert torch.allclose(image, want if query.dim() == 3 else want[0], atol=1e-5)


def test_a_million_gaussians_stay_within_the_bound():
    n = 1_000_000
    means = 5 * torch.randn(n, 3, device="cuda")
    model = (
        means,
        torch.randn(n, 4, device="cuda"),
        torch.full((n, 3), 0.3).cuda(),
        torch.full((n,), 0.3).cuda(),
    )
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    plan = make_plan(*model, poses(0).to("cuda"), GRID)
    grown = torch.cuda.max_memory_allocated() - before
    entries = plan.buffers[6].numel() // 2
    assert grown < 40 * entries + 400 * n

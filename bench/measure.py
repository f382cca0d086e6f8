"""Measurements of gpu.py's stages: medians and 95th percentiles, as ratios to the device's roofline.

Kernels are timed as replays of captured graphs between events, queued behind a wait so that the host is not
timed; `cold` ones find nothing of their own in the second-level cache. End to end is from a call to its
finished result.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from record import guarded
from torch import Tensor

from gsparc.ops import Pose, SphereGrid, composite, freeze, make_plan, mean_weights, rasterize
from gsparc.ops.networks import networks
from gsparc.ops.operators import composite_gradient
from gsparc.prediction.timing import ClockSettings, interleaved
from gsparc.training.losses import ssim

GRID = SphereGrid.hemisphere()
Model = tuple[Tensor, Tensor, Tensor, Tensor]

# Floating-point operations of one pixel inside one footprint, read off csrc/pixels.h and csrc/layer.h.
FORWARD_FLOPS, PER_CHANNEL = 42, 2
BACKWARD_FLOPS = 120

AHEAD = 400_000  # cycles that the device waits while the host queues what is timed: about 0.2 ms


def scene(count: int, seed: int = 0) -> Model:
    """A field as training starts with it: over the upper hemisphere, footprints as wide as their spacing."""
    draw = torch.Generator().manual_seed(seed)
    step = torch.arange(count) + 0.5
    height, azimuth = step / count, torch.pi * (1 + 5**0.5) * step
    horizontal = (1 - height**2).sqrt()
    distance = 1 + 5 * torch.rand(count, 1, generator=draw)
    means = distance * torch.stack([horizontal * azimuth.cos(), horizontal * azimuth.sin(), height], -1)
    scales = distance * (2 * torch.pi / count) ** 0.5 * (0.5 + torch.rand(count, 3, generator=draw))
    quats = torch.randn(count, 4, generator=draw)
    opacities = 0.1 + 0.4 * torch.rand(count, generator=draw)
    return means.cuda(), quats.cuda(), scales.cuda(), opacities.cuda()


def origin(count: int = 0) -> Pose:
    """The pose at the origin, or `count` poses around it."""
    if count == 0:
        return Pose.identity(torch.zeros(3)).to("cuda")
    return Pose.identity(0.3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(1))).to("cuda")


def event_ms(
    function: Callable[[], Any], rounds: int = 30, *, inner: int = 1, forget: Tensor | None = None
) -> dict[str, float]:
    """Milliseconds of `function`, which is `inner` calls, between device events.

    `forget` is a buffer larger than the second-level cache, written before each round.
    """
    for _ in range(3):
        function()
    times = []
    for _ in range(rounds):
        first, last = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        if forget is not None:
            forget.zero_()
        torch.cuda._sleep(AHEAD)
        first.record()
        function()
        last.record()
        last.synchronize()
        times.append(first.elapsed_time(last) / inner)
    return spread(times)


def spread(times: list[float]) -> dict[str, float]:
    """Median and 95th percentile."""
    times = sorted(times)
    return {"p50": statistics.median(times), "p95": times[int(0.95 * (len(times) - 1))]}


def wall_ms(function: Callable[[], Any], rounds: int = 60) -> dict[str, float]:
    """Milliseconds from call to finished result, as a caller sees them."""
    clock = ClockSettings(rounds, least=rounds, warmup=5)
    return spread(interleaved({"it": lambda turn: function()}, clock)["it"].tolist())


def graph_of(function: Callable[[], Any], inner: int = 1) -> torch.cuda.CUDAGraph:
    """`inner` calls as one captured graph."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side), torch.no_grad():
        for _ in range(2):
            function()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph), torch.no_grad():
        outputs = [function() for _ in range(inner)]
    del outputs
    return graph


def kernel_ms(function: Callable[[], Any], inner: int = 10, rounds: int = 100) -> dict[str, float]:
    """Milliseconds of the kernels alone: replays of a graph that holds several calls."""
    return event_ms(graph_of(function, inner).replay, rounds, inner=inner)


def cold_ms(function: Callable[[], Any]) -> dict[str, float]:
    """The same of one call that finds nothing of its own in the second-level cache."""
    size = 4 * torch.cuda.get_device_properties().L2_cache_size
    cache = torch.empty(size, dtype=torch.uint8, device="cuda")
    return event_ms(graph_of(function).replay, rounds=100, forget=cache)


def ceilings() -> dict[str, Any]:
    """Roofline of this device: copy bandwidth, float32 rate, and the time of an empty launch."""
    big = torch.randn(512 * 2**20, device="cuda")
    other = torch.empty_like(big)
    copy = event_ms(partial(other.copy_, big))["p50"]
    del big, other
    torch.backends.cuda.matmul.allow_tf32 = False
    a, b = (torch.randn(8192, 8192, device="cuda") for _ in range(2))
    product = event_ms(lambda: a @ b, rounds=8)["p50"]
    one = torch.zeros(1, device="cuda")
    return {
        "copy_tb_s": 2 * 4 * 512 * 2**20 / copy / 1e9,
        "float32_tflop_s": 2 * 8192**3 / product / 1e9,
        "empty_launch_ms": kernel_ms(lambda: one.add_(1), inner=20)["p50"],
        "empty_graph_ms": kernel_ms(lambda: one.add_(1), inner=1)["p50"],
    }


def compared(times: dict[str, float], bytes_: float, flops: float, limits: dict[str, Any]) -> dict[str, Any]:
    """Times beside the roofline's lower bound for so many bytes and operations."""
    by_bytes, by_flops = bytes_ / limits["copy_tb_s"] / 1e9, flops / limits["float32_tflop_s"] / 1e9
    floor = max(by_bytes, by_flops)
    return times | {
        "floor_ms": floor,
        "bound_by": "bytes" if by_bytes > by_flops else "arithmetic",
        "ratio": times["p50"] / floor,
        "ratio_p95": times["p95"] / floor,
        "ratio_with_one_launch": times["p50"] / (floor + limits["empty_launch_ms"]),
    }


def counted_pairs(model: Model, pose: Pose) -> tuple[int, int]:
    """(pixel, Gaussian) pairs with a positive weight, and entries of the plan."""
    view = freeze(make_plan(*model, pose, GRID), *model, version=0)
    return int((view.buffers[3] > 0).sum()), len(view.buffers[2])


def pipeline(count: int, limits: dict[str, Any]) -> dict[str, Any]:
    """One static receiver, one real channel: kernels alone, and end to end from call to result."""
    model, pose, features = scene(count), origin(), torch.rand(count, 1, device="cuda")
    pairs, entries = counted_pairs(model, pose)
    plan = make_plan(*model, pose, GRID)
    pixels = GRID.height * GRID.width
    results: dict[str, Any] = {"pairs": pairs, "entries": entries, "pairs_per_pixel": pairs / pixels}

    # Minimal bytes and operations: the model once, the plan's records once, images once.
    image, gaussians, records = 8 * pixels, 4 * count * 12, 4 * count * 21
    planning = (gaussians + records, 0)
    forward = (gaussians + image, pairs * (FORWARD_FLOPS + PER_CHANNEL))
    whole = (gaussians + image, forward[1])
    backward = (2 * gaussians + 3 * image, pairs * BACKWARD_FLOPS)
    step_cost = (3 * gaussians + 4 * image, forward[1] + backward[1])
    thawing = (4 * pairs, 2 * pairs)

    view = freeze(plan, *model, version=0)
    query, thaw = (lambda: rasterize(*model, features, pose, GRID)), (lambda: view.render(features, 0))
    calls: dict[str, tuple[Callable[[], Any], tuple[int, int]]] = {
        "plan": (lambda: make_plan(*model, pose, GRID), planning),
        "forward": (lambda: composite(plan, *model, features), forward),
        "plan_and_forward": (query, whole),
        "backward": (backward_of(plan, model, features[None]), backward),
        "frozen_query": (thaw, thawing),
    }
    for name, (call, cost) in calls.items():
        results[name] = guarded(lambda call=call, cost=cost: compared(kernel_ms(call), *cost, limits))
        results[f"{name}_cold"] = guarded(lambda call=call, cost=cost: compared(cold_ms(call), *cost, limits))

    leaves = [tensor.clone().requires_grad_() for tensor in (*model, features)]
    upstream = torch.randn(1, 1, GRID.height, GRID.width, device="cuda")

    def step() -> None:
        rasterize(*leaves, pose, GRID).image.backward(upstream)

    with torch.no_grad():
        ends = {
            "forward": (query, whole),
            "frozen": (thaw, thawing),
            "graph": (graph_of(query).replay, whole),
        }
        for name, (call, cost) in ends.items():
            results[f"end_to_end_{name}"] = compared(wall_ms(call), *cost, limits)
    results["end_to_end_forward_backward"] = compared(wall_ms(step), *step_cost, limits)
    return results


def backward_of(plan: Any, model: Model, features: Tensor) -> Callable[[], Any]:
    """The backward operator alone, for an upstream gradient of noise."""
    raster = composite(plan, *model, features)
    upstream = torch.randn_like(raster.image)
    inputs = (upstream, None, raster.image, raster.transmittance, plan.means2d, features, *model, None)
    return lambda: composite_gradient(plan, *inputs)


def many_poses(count: int, poses: int, limits: dict[str, Any]) -> dict[str, Any]:
    """A training batch of a moving receiver, and of a static one with as many samples."""
    model, several = scene(count), origin(poses)
    features = torch.rand(poses, count, 1, device="cuda")
    pairs = sum(
        counted_pairs(model, Pose(p, r))[0] for p, r in zip(several.position, several.rotation, strict=True)
    )
    image_bytes = 4 * poses * GRID.height * GRID.width
    plan = make_plan(*model, several, GRID)
    still = make_plan(*model, origin(), GRID)
    forward = kernel_ms(lambda: composite(plan, *model, features), inner=3)
    shared = kernel_ms(lambda: composite(still, *model, features), inner=3)
    pairs_shared = counted_pairs(model, origin())[0]
    moved = 48 * count * poses + 2 * image_bytes
    flops, flops_shared = pairs * (FORWARD_FLOPS + 2), pairs_shared * (FORWARD_FLOPS + 2 * poses)
    return {
        "plan": kernel_ms(lambda: make_plan(*model, several, GRID), inner=3),
        "forward": compared(forward, moved, flops, limits),
        "forward_shared_pose": compared(shared, 48 * count + image_bytes, flops_shared, limits),
        "weights": kernel_ms(lambda: mean_weights(plan, *model), inner=3),
        "backward_shared_pose": kernel_ms(backward_of(still, model, features), inner=3),
    }


BATCHES = (1, 16, 64, 256, 1024, 4096)


def frozen(count: int, limits: dict[str, Any]) -> dict[str, Any]:
    """Spectra per second of a static receiver by the size of the batch: user calls and captured graphs."""
    model, pose = scene(count), origin()
    view = freeze(make_plan(*model, pose, GRID), *model, version=0)
    weights, pixels = int((view.buffers[3] > 0).sum()), GRID.height * GRID.width
    results: dict[str, Any] = {"gaussians": count, "weights_not_zero": weights}
    results["share_of_weights_not_zero"] = weights / (count * pixels)
    for batch in BATCHES:
        features = torch.rand(batch, count, 1, device="cuda")
        query = partial(view.render, features, 0)
        cost = 4 * batch * pixels, 2 * batch * weights  # images written, products of weights not zero
        with torch.no_grad():
            kernels = guarded(lambda q=query, c=cost: compared(kernel_ms(q, inner=2, rounds=30), *c, limits))
            wall = wall_ms(query, rounds=30)
        rates = {"": wall["p50"], "_captured": kernels.get("p50", math.nan)}
        rates = {f"spectra_per_s{name}": 1e3 * batch / ms for name, ms in rates.items()}
        results[f"batch{batch}"] = {"end_to_end": wall, "kernels": kernels, **rates}
    return results


def network_weights(count: int, inputs: int, hidden: int, outputs: int) -> list[Tensor]:
    """Weights and biases of N networks of one hidden layer."""
    shapes = (inputs, hidden), (hidden,), (hidden, outputs), (outputs,)
    return [torch.randn(count, *shape, device="cuda") for shape in shapes]


def emission(count: int, batch: int, limits: dict[str, Any]) -> dict[str, Any]:
    """The emission networks alone (33-32-2), forward and backward."""
    weights, results = network_weights(count, 33, 32, 2), {}
    for samples in (1, batch):
        encoded = torch.randn(samples, 33, device="cuda")
        flops = 2 * samples * count * (33 * 32 + 64)
        bytes_ = 4 * sum(w.numel() for w in weights) + 8 * samples * count
        ours = kernel_ms(partial(networks, encoded, *weights), inner=2)
        results[f"batch{samples}"] = compared(ours, bytes_, flops, limits)
    leaves = [weight.requires_grad_() for weight in weights]
    out = networks(encoded, *leaves)
    slope = torch.randn_like(out)
    grads = partial(torch.autograd.grad, out, leaves, slope, retain_graph=True)
    return results | {"backward": event_ms(grads, rounds=10)}


def similarity(batch: int, limits: dict[str, Any]) -> dict[str, Any]:
    """The structural similarity of a batch with its gradient."""
    images = torch.rand(2, batch, GRID.height, GRID.width, device="cuda")
    prediction, target = images[0].requires_grad_(), images[1]

    def step() -> Any:
        return torch.autograd.grad(ssim(prediction, target).sum(), prediction)

    # Windows of 11 and 11 taps over five maps and, transposed, over three; images read, a gradient written.
    pixels = prediction.numel()
    return {"end_to_end": wall_ms(step)} | compared(event_ms(step), 12 * pixels, 2 * 22 * 8 * pixels, limits)

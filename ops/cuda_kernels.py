"""The operators of this package by the CUDA kernels, on torch's current stream.

A plan's buffers have the shapes of the CPU's, with contents of their own: records, boxes and entries go by
Gaussian instead of by rank, the last of the strip starts is the number of entries, and the entries hold the
tiles' starts (P tiles + 1), then for each entry its Gaussian and its slot.

Inside a captured CUDA graph nothing may synchronise, so a plan has room for as many entries as earlier plans
of this size needed, plus headroom; if it needs more, its images and gradients are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, cuda_library, validation
from gsparc.ops.geometry import Gaussians
from gsparc.ops.networks import Layers
from gsparc.ops.operators import Buffers, Poses, check_memory, contiguous, empty_like, plan_tensors
from gsparc.ops.settings import KernelSettings

BYTES_PER_ENTRY = 36  # entries and what sorting them takes
MOST_PAIRS = 2**31  # of poses and Gaussians: the kernels count them in 32 bits

libraries: dict[str, cuda_library.Library] = {}
"""By device type; tests put the host shim under "cpu"."""

_capacities: dict[tuple, int] = {}


def tiles(settings: KernelSettings) -> int:
    """Tiles of one pose's image."""
    return -(-settings.height // _native.TILE_HEIGHT) * -(-settings.width // _native.TILE_WIDTH)


def _with_headroom(entries: int) -> int:
    """Capacity of a captured plan where the largest plan so far had so many entries."""
    return entries + entries // 4 + 1024


def _capturing(tensor: Tensor) -> bool:
    return tensor.is_cuda and torch.cuda.is_current_stream_capturing()


def call_for(like: Tensor, tensors: Sequence[Tensor | None], **numbers: Any) -> cuda_library.Call:
    """A call in the precision and on the device of `like`; `numbers` are fields of `Call`."""
    call = cuda_library.Call(twice=like.dtype == torch.float64, device=like.device.index or 0, **numbers)
    call.tensors[: len(tensors)] = [0 if t is None else t.data_ptr() for t in tensors]
    return call


def run(name: str, like: Tensor, *tensors: Tensor | None, **numbers: Any) -> None:
    """Call a kernel with addresses of tensors and scratch memory, on the stream of `like`'s device."""
    library, device = libraries[like.device.type], like.device
    call = call_for(like, tensors, **numbers)
    with torch.cuda.device(device) if like.is_cuda else nullcontext():
        needed = library.run(name, call)
        scratch = torch.empty(needed, dtype=torch.uint8, device=device)
        call.scratch = scratch.data_ptr()
        call.stream = torch.cuda.current_stream(device).cuda_stream if like.is_cuda else 0
        library.run(name, call)


@cache
def _tables(device: torch.device, dtype: torch.dtype, settings: KernelSettings) -> Tensor:
    """Sines and cosines of the grid's rows and columns, kept for good: captured graphs hold their address."""
    library = libraries[device.type]
    call = call_for(torch.empty(0, dtype=dtype), (), settings=settings)
    numbers = torch.empty(library.run("tables", call), dtype=dtype)
    call.tensors[0] = numbers.data_ptr()
    library.run("tables", call)
    return numbers.to(device)


def capacity_of(buffers: Buffers, poses: int, settings: KernelSettings) -> int:
    """How many entries a plan has room for."""
    return (buffers.entries.numel() - poses * tiles(settings) - 1) // 2


def run_on_plan(
    name: str,
    buffers: Buffers,
    gaussians: Gaussians,
    poses: Poses,
    settings: KernelSettings,
    *tensors: Tensor | None,
    **numbers: Any,
) -> None:
    """Call a kernel that reads a plan (`read_view`), Gaussians and poses, then `tensors`."""
    means, count = gaussians.means, len(poses.positions)
    entries = buffers.entries if buffers.entries.numel() else None
    view = (_tables(means.device, means.dtype, settings), *buffers[:5], buffers.starts[-1:], entries)
    numbers = {"capacity": capacity_of(buffers, count, settings), **numbers}
    sizes = {"poses": count, "count": len(means), "settings": settings}
    run(name, means, *view, *contiguous((*gaussians, *poses)), *tensors, **sizes, **numbers)


def plan(
    gaussians: Gaussians, ids: Tensor | None, poses: Poses, settings: KernelSettings
) -> tuple[Buffers, Tensor, Tensor, Tensor]:
    """`gsparc::plan`."""
    means, count, n = gaussians.means, len(poses.positions), len(gaussians.means)
    if count * n >= MOST_PAIRS:
        raise MemoryError(
            f"{count} poses of {n} Gaussians are too many for a plan: take fewer poses at a time"
        )
    buffers, means2d, radii, visible = plan_tensors(means, count, settings.height, 0)
    starts = count * tiles(settings) + 1
    if n == 0:
        zeros = [buffer.zero_() for buffer in buffers[:-1]]
        return Buffers(*zeros, buffers.entries.new_zeros(starts)), means2d, radii, visible
    verdict = means.new_empty(2, dtype=torch.int64)
    outputs = (*contiguous([ids]), means2d, radii, visible, verdict)
    run_on_plan("plan", buffers, gaussians, poses, settings, *outputs, capacity=0)
    key = (count, n, settings)
    if _capturing(means):
        if key not in _capacities:
            raise RuntimeError("plan once before capturing: a graph cannot ask how many entries are needed")
        capacity = _with_headroom(_capacities[key])
    else:
        status, capacity = verdict.tolist()
        validation.raise_for_status(status)
        _capacities[key] = max(capacity, _capacities.get(key, 0))
    check_memory(capacity, BYTES_PER_ENTRY)
    buffers = buffers._replace(entries=means.new_empty(starts + 2 * capacity, dtype=torch.int32))
    run_on_plan("bin", buffers, gaussians, poses, settings)
    return buffers, means2d, radii, visible


def _by_gaussian(features: Tensor, poses: Poses) -> Tensor:
    """Features (B, N, C) as (P, N, K) with the K channels of a pose side by side."""
    if len(poses.positions) != 1:
        return features.contiguous()
    samples, n, channels = features.shape
    return features.permute(1, 0, 2).reshape(1, n, samples * channels).contiguous()


def composite(
    means2d: Tensor,
    gaussians: Gaussians,
    features: Tensor,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> tuple[Tensor, Tensor]:
    """`gsparc::composite`."""
    samples, _, channels = features.shape
    image = features.new_empty(samples, channels, settings.height, settings.width)
    transmittance = features.new_empty(len(poses.positions), settings.height, settings.width)
    rows = _by_gaussian(features, poses)
    tensors = (rows, image, transmittance)
    run_on_plan("composite", buffers, gaussians, poses, settings, *tensors, channels=rows.shape[2])
    return image, transmittance


def composite_backward(
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    gaussians: Gaussians,
    features: Tensor,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> tuple[Gaussians, Tensor, Tensor]:
    """`gsparc::composite_backward`."""
    count, (samples, n, channels) = len(poses.positions), features.shape
    rows = _by_gaussian(features, poses)
    width, entries = rows.shape[2], capacity_of(buffers, count, settings)
    check_memory(entries, features.element_size() * (_native.MOMENTS + width))
    grads, grad_rows = empty_like(gaussians), torch.empty_like(rows)
    grad_means2d = features.new_empty(count, n, 2)
    images = contiguous((image, transmittance, grad_image, grad_transmittance))
    tensors = (rows, *images, *grads, grad_rows, grad_means2d)
    if n > 0:
        run_on_plan(
            "composite_backward", buffers, gaussians, poses, settings, *tensors, channels=rows.shape[2]
        )
    if count == 1:
        grad_rows = grad_rows.reshape(n, samples, channels).permute(1, 0, 2).contiguous()
    return grads, grad_rows, grad_means2d


def weights(
    gaussians: Gaussians, poses: Poses, buffers: Buffers, settings: KernelSettings
) -> tuple[Tensor, Tensor]:
    """`gsparc::weights`."""
    sums = gaussians.means.new_empty(len(poses.positions), len(gaussians.means), 2)
    if sums.numel():
        run_on_plan("weights", buffers, gaussians, poses, settings, sums, None, None)
    return sums[..., 0].clone(), sums[..., 1].clone()


def weights_backward(
    grad_seen: Tensor,
    grad_total: Tensor,
    gaussians: Gaussians,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> Gaussians:
    """`gsparc::weights_backward`."""
    entries = capacity_of(buffers, len(poses.positions), settings)
    check_memory(entries, gaussians.means.element_size() * (_native.MOMENTS + 1))
    grads = empty_like(gaussians)
    tensors = (*contiguous((grad_seen, grad_total)), *grads)
    if len(gaussians.means) > 0:
        run_on_plan("weights_backward", buffers, gaussians, poses, settings, *tensors, channels=1)
    return grads


def _sizes(encoded: Tensor, layers: Layers) -> dict[str, int]:
    count, inputs, hidden = layers.weight1.shape
    sizes = {"samples": len(encoded), "count": count, "channels": layers.weight2.shape[2]}
    return {**sizes, "inputs": inputs, "hidden": hidden}


def networks(encoded: Tensor, layers: Layers) -> Tensor:
    """`gsparc::networks`."""
    out = encoded.new_empty(len(encoded), len(layers.weight1), layers.weight2.shape[2])
    if out.numel():
        run("networks", encoded, *contiguous((encoded, *layers)), out, **_sizes(encoded, layers))
    return out


def networks_backward(slope: Tensor, encoded: Tensor, layers: Layers) -> Layers:
    """`gsparc::networks_backward`."""
    grads = Layers(*(layer.new_zeros(layer.shape) for layer in layers))
    tensors = (*contiguous((encoded, *layers, slope)), *grads)
    if slope.numel():
        run("networks_backward", encoded, *tensors, **_sizes(encoded, layers))
    return grads


def similarity(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor | None]:
    """`gsparc::similarity` (ValueError: a window that is not symmetric, or wider than the kernels take)."""
    half, (samples, height, width) = list(taps)[: len(taps) // 2 + 1], prediction.shape
    radius = len(half) - 1
    if radius > _native.MOST_RADIUS or list(taps) != [*half, *half[-2::-1]]:
        most = 2 * _native.MOST_RADIUS + 1
        raise ValueError(f"the window is symmetric and has at most {most} taps, got {list(taps)}")
    rows, columns = height - 2 * radius, width - 2 * radius
    blocks = -(-rows // _native.SIMILARITY_HEIGHT) * -(-columns // _native.SIMILARITY_WIDTH)
    sums = prediction.new_empty(samples, blocks)
    slopes = torch.empty_like(prediction, memory_format=torch.contiguous_format) if slope else None
    inputs = [prediction.contiguous(), target.contiguous(), target.mean(dim=(-2, -1))]
    sizes = {"samples": samples, "height": height, "width": width, "radius": radius}
    if samples:
        run("similarity", prediction, *inputs, sums, slopes, window=(*stability, *half), **sizes)
    return sums.sum(1) / (rows * columns), slopes

"""The operators of this package by the CUDA kernels, on torch's current stream.

A plan's buffers have the shapes of the CPU's, with contents of their own: records, boxes and entries go by
Gaussian instead of by rank, the last of the strip starts is the number of entries, and the entries hold the
tiles' starts (P tiles + 1), then for each entry its Gaussian and its slot.

Inside a captured CUDA graph nothing may wait for the GPU, so a plan takes as many entries as plans of this
size have needed before, and some more; should it need more, its images and gradients are NaN, never wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache

import torch
from torch import Tensor

from gsparc.ops import cuda_library, door
from gsparc.ops.operators import check_memory, filled, gradients, layout, model_of, plan_tensors

TILE_WIDTH, TILE_HEIGHT = 8, 4
BYTES_PER_ENTRY = 36  # entries and what sorting them takes
SIMILARITY_TILE, MOST_RADIUS = (8, 32), 5  # rows and columns of a block; its widest window
MOST_PAIRS = 2**31  # of poses and Gaussians: the kernels count them in 32 bits

libraries: dict[str, cuda_library.Library] = {}
"""By device type; tests put the host shim under "cpu"."""

_capacities: dict[tuple, int] = {}


def tiles(whole: Sequence[int]) -> int:
    """Tiles of one pose's image."""
    return -(-whole[0] // TILE_HEIGHT) * -(-whole[1] // TILE_WIDTH)


def _roomy(entries: int) -> int:
    """Room of a captured plan where the largest seen had so many entries."""
    return entries + entries // 4 + 1024


def _capturing(tensor: Tensor) -> bool:
    return tensor.is_cuda and torch.cuda.is_current_stream_capturing()


def run(
    name: str,
    like: Tensor,
    *tensors: Tensor | None,
    whole: Sequence[int] = (),
    real: Sequence[float] = (),
    sizes: dict[str, int],
) -> None:
    """Call a kernel with addresses of tensors and scratch memory, on the stream of `like`'s device."""
    library, device = libraries[like.device.type], like.device
    call = cuda_library.Call(twice=like.dtype == torch.float64, device=device.index or 0, **sizes)
    call.whole[: len(whole)], call.real[: len(real)] = list(whole), list(real)
    addresses = [0 if t is None else t.data_ptr() for t in tensors]
    call.tensors[: len(addresses)] = addresses
    with torch.cuda.device(device) if like.is_cuda else nullcontext():
        needed = library.run(name, call)
        scratch = torch.empty(needed, dtype=torch.uint8, device=device)
        call.scratch = scratch.data_ptr()
        call.stream = torch.cuda.current_stream(device).cuda_stream if like.is_cuda else 0
        library.run(name, call)


@cache
def _tables(device: torch.device, dtype: torch.dtype, whole: tuple, real: tuple) -> Tensor:
    """Sines and cosines of the grid's rows and columns, kept for good: captured graphs hold their address."""
    library = libraries[device.type]
    call = cuda_library.Call(twice=dtype == torch.float64)
    call.whole[:], call.real[:] = list(whole), list(real)
    numbers = torch.empty(library.run("tables", call), dtype=dtype)
    call.tensors[0] = numbers.data_ptr()
    library.run("tables", call)
    return numbers.to(device)


def view_of(means: Tensor, buffers: Sequence[Tensor], whole: Sequence[int], real: Sequence[float]) -> list:
    """The addresses of `read_view`."""
    tables = _tables(means.device, means.dtype, tuple(whole), tuple(real))
    return [tables, *buffers[:5], buffers[5][-1:], buffers[6] if len(buffers) > 6 else None]


def capacity_of(buffers: Sequence[Tensor], poses: int, whole: Sequence[int]) -> int:
    """How many entries a plan has room for."""
    return (buffers[6].numel() - poses * tiles(whole) - 1) // 2


def plan(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    strongest: Tensor,
    ids: Tensor | None,
    positions: Tensor,
    rotations: Tensor,
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`gsparc::plan`."""
    poses, n = positions.shape[0], means.shape[0]
    if poses * n >= MOST_PAIRS:
        raise MemoryError(
            f"{poses} poses of {n} Gaussians are too many for a plan: take fewer poses at a time"
        )
    tensors = plan_tensors(means, poses, whole[0])
    starts = poses * tiles(whole) + 1
    if n == 0:
        return (*(t.zero_() for t in tensors[:6]), tensors[3].new_zeros(starts), *tensors[6:])  # type: ignore[return-value]
    *buffers, means2d, radii, visible = tensors
    model = [t.contiguous() for t in (means, quats, scales, strongest)]
    view = [positions.contiguous(), rotations.contiguous()]
    verdict = means.new_empty(2, dtype=torch.int64)
    sizes = {"poses": poses, "count": n}
    outputs = (None if ids is None else ids.contiguous(), means2d, radii, visible, verdict)
    run(
        "plan",
        means,
        *view_of(means, buffers, whole, real),
        *model,
        None,
        *view,
        *outputs,
        whole=whole,
        real=real,
        sizes=sizes,
    )
    key = (poses, n, tuple(whole))
    if _capturing(means):
        if key not in _capacities:
            raise RuntimeError("plan once before capturing: a graph cannot ask how many entries are needed")
        capacity = _roomy(_capacities[key])
    else:
        wrong, capacity = verdict.tolist()
        if wrong == layout().UNSOUND_POSE:
            door.raise_for_pose()
        if wrong >= 0:
            door.raise_for(("means", "quats", "scales", "opacities")[wrong % 4], wrong // 4)
        _capacities[key] = max(capacity, _capacities.get(key, 0))
    check_memory(capacity, BYTES_PER_ENTRY)
    buffers.append(means.new_empty(starts + 2 * capacity, dtype=torch.int32))
    sizes["capacity"] = capacity
    run("bin", means, *view_of(means, buffers, whole, real), whole=whole, real=real, sizes=sizes)
    return (*buffers, means2d, radii, visible)  # type: ignore[return-value]


def _by_gaussian(features: Tensor, poses: int) -> Tensor:
    """Features (B, N, C) as (P, N, K) with the K channels of a pose side by side."""
    if poses != 1:
        return features.contiguous()
    samples, n, channels = features.shape
    return features.permute(1, 0, 2).reshape(1, n, samples * channels).contiguous()


def _channels(features: Tensor, poses: int) -> int:
    return features.shape[2] * (features.shape[0] if poses == 1 else 1)


def composite(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    features: Tensor,
    means2d: Tensor,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """`gsparc::composite`."""
    poses = positions.shape[0]
    image = features.new_empty(features.shape[0], features.shape[2], *whole[:2])
    transmittance = means.new_empty(poses, *whole[:2])
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    rows = _by_gaussian(features, poses)
    tensors = [*view_of(means, buffers, whole, real), *model, rows, image, transmittance]
    sizes = {"poses": poses, "count": means.shape[0], "channels": _channels(features, poses)}
    sizes["capacity"] = capacity_of(buffers, poses, whole)
    run("composite", means, *tensors, whole=whole, real=real, sizes=sizes)
    return image, transmittance


def composite_backward(
    grad_image: Tensor,
    grad_transmittance: Tensor | None,
    image: Tensor,
    transmittance: Tensor,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    features: Tensor,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`gsparc::composite_backward`."""
    poses, n, capacity = positions.shape[0], means.shape[0], capacity_of(buffers, positions.shape[0], whole)
    channels = _channels(features, poses)
    check_memory(capacity, means.element_size() * (layout().MOMENTS + channels))
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    grads = gradients(means, quats, scales, opacities, extinctions)
    rows = _by_gaussian(features, poses)
    slopes, screen = torch.empty_like(rows), means.new_empty(poses, n, 2)
    behind = None if grad_transmittance is None else grad_transmittance.contiguous()
    inputs = [rows, image.contiguous(), transmittance.contiguous(), grad_image.contiguous(), behind]
    tensors = [*view_of(means, buffers, whole, real), *model, *inputs, *grads, slopes, screen]
    sizes = {"poses": poses, "count": n, "channels": channels, "capacity": capacity}
    if n > 0:
        run("composite_backward", means, *tensors, whole=whole, real=real, sizes=sizes)
    if poses == 1:
        samples, _, width = features.shape
        slopes = slopes.reshape(n, samples, width).permute(1, 0, 2).contiguous()
    return (*filled(grads, means), slopes, screen)


def weights(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """`gsparc::weights`."""
    poses, n = positions.shape[0], means.shape[0]
    sums = means.new_empty(poses, n, 2)
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    tensors = [*view_of(means, buffers, whole, real), *model, sums, None, None]
    if n > 0:
        sizes = {"poses": poses, "count": n, "capacity": capacity_of(buffers, poses, whole)}
        run("weights", means, *tensors, whole=whole, real=real, sizes=sizes)
    return sums[..., 0].clone(), sums[..., 1].clone()


def weights_backward(
    grad_seen: Tensor,
    grad_total: Tensor,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    extinctions: Tensor | None,
    positions: Tensor,
    rotations: Tensor,
    buffers: Sequence[Tensor],
    whole: Sequence[int],
    real: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`gsparc::weights_backward`."""
    poses, n, capacity = positions.shape[0], means.shape[0], capacity_of(buffers, positions.shape[0], whole)
    check_memory(capacity, means.element_size() * (layout().MOMENTS + 1))
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    grads = gradients(means, quats, scales, opacities, extinctions)
    slopes = [grad_seen.contiguous(), grad_total.contiguous()]
    tensors = [*view_of(means, buffers, whole, real), *model, *slopes, *grads]
    if n > 0:
        sizes = {"poses": poses, "count": n, "channels": 1, "capacity": capacity}
        run("weights_backward", means, *tensors, whole=whole, real=real, sizes=sizes)
    return filled(grads, means)


def networks(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """`gsparc::networks`."""
    inputs = [t.contiguous() for t in (encoded, weight1, bias1, weight2, bias2)]
    samples, (count, width, hidden), channels = encoded.shape[0], weight1.shape, weight2.shape[2]
    out = encoded.new_empty(samples, count, channels)
    sizes = {"samples": samples, "count": count, "channels": channels}
    if out.numel():
        run("networks", encoded, *inputs, out, whole=(width, hidden), sizes=sizes)
    return out


def networks_backward(
    slope: Tensor, encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`gsparc::networks_backward`."""
    inputs = [t.contiguous() for t in (encoded, weight1, bias1, weight2, bias2, slope)]
    samples, (count, width, hidden), channels = encoded.shape[0], weight1.shape, weight2.shape[2]
    grads = [torch.zeros_like(t, memory_format=torch.contiguous_format) for t in inputs[1:5]]
    sizes = {"samples": samples, "count": count, "channels": channels}
    if slope.numel():
        run("networks_backward", encoded, *inputs, *grads, whole=(width, hidden), sizes=sizes)
    return grads[0], grads[1], grads[2], grads[3]


def similarity(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor]:
    """`gsparc::similarity` (ValueError: a window that is not symmetric, or wider than the kernels take)."""
    half, (samples, height, width) = list(taps)[: len(taps) // 2 + 1], prediction.shape
    radius = len(half) - 1
    if radius > MOST_RADIUS or list(taps) != [*half, *half[-2::-1]]:
        most = 2 * MOST_RADIUS + 1
        raise ValueError(f"the window is symmetric and has at most {most} taps, got {list(taps)}")
    rows, columns = height - 2 * radius, width - 2 * radius
    sums = prediction.new_empty(samples, -(-rows // SIMILARITY_TILE[0]) * -(-columns // SIMILARITY_TILE[1]))
    slopes = torch.empty_like(prediction, memory_format=torch.contiguous_format) if slope else None
    inputs = [prediction.contiguous(), target.contiguous(), target.mean(dim=(-2, -1))]
    whole, real = (height, width, radius), (*stability, *half)
    if samples:
        tensors = (*inputs, sums, slopes)
        run("similarity", prediction, *tensors, whole=whole, real=real, sizes={"samples": samples})
    value = sums.sum(1) / (rows * columns)
    return value, prediction.new_empty(0) if slopes is None else slopes

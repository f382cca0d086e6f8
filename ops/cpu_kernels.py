"""The operators of this package by the C++ kernels.

Tensors go to them as addresses; the caller keeps them alive, and torch's number of threads goes along.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, door
from gsparc.ops.operators import check_memory, filled, gradients, model_of, plan_tensors


def addresses(*tensors: Tensor | None) -> list[int]:
    """Where tensors lie; 0 stands for none."""
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


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
    poses, n, twice, threads = (
        positions.shape[0],
        means.shape[0],
        means.dtype == torch.float64,
        torch.get_num_threads(),
    )
    *buffers, means2d, radii, visible = plan_tensors(means, poses, whole[0])
    inputs = [t.contiguous() for t in (means, quats, scales, strongest)]
    outputs = (*buffers, means2d, radii, visible)
    wrong = _native.plan(
        *(twice, poses, n, threads, whole, real),
        addresses(*inputs, None, positions.contiguous(), rotations.contiguous(), ids, *outputs),
    )
    if wrong == _native.UNSOUND_POSE:
        door.raise_for_pose()
    if wrong >= 0:
        door.raise_for(("means", "quats", "scales", "opacities")[wrong % 4], wrong // 4)
    count = int(buffers[-1][-1])
    check_memory(count, 4)
    entries = means.new_empty(count, dtype=torch.int32)
    _native.entries(twice, poses, n, threads, whole[0], addresses(*buffers, entries))
    plan: Any = (*buffers, entries, means2d, radii, visible)
    return plan


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
    samples, n, channels = features.shape
    image = features.new_empty(samples, channels, *whole[:2])
    transmittance = means.new_empty(positions.shape[0], *whole[:2])
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    features = features.contiguous()
    _native.composite(
        *(means.dtype == torch.float64, positions.shape[0], n, samples, channels, torch.get_num_threads()),
        *(whole, real, addresses(*buffers, *model, features, image, transmittance)),
    )
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
    samples, n, channels = features.shape
    poses = positions.shape[0]
    check_memory(
        buffers[-1].shape[0],
        means.element_size() * (_native.MOMENTS + (samples * channels if poses == 1 else channels)),
    )
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    grads = gradients(means, quats, scales, opacities, extinctions)
    grad_features, grad_screen = (
        features.new_empty(features.shape),
        means.new_empty(poses, n, 2),
    )
    inputs = [t.contiguous() for t in (features, image, transmittance, grad_image)]
    grad_transmittance = None if grad_transmittance is None else grad_transmittance.contiguous()
    _native.composite_backward(
        *(means.dtype == torch.float64, poses, n, samples, channels, torch.get_num_threads(), whole, real),
        addresses(*buffers, *model, *inputs, grad_transmittance, *grads, grad_features, grad_screen),
    )
    outputs: Any = (*filled(grads, means), grad_features, grad_screen)
    return outputs


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
    seen, total = means.new_empty(poses, n), means.new_empty(poses, n)
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    _native.weights(
        *(means.dtype == torch.float64, poses, n, torch.get_num_threads(), whole, real),
        addresses(*buffers, *model, seen, total),
    )
    return seen, total


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
    poses, n = positions.shape[0], means.shape[0]
    check_memory(buffers[-1].shape[0], means.element_size() * _native.MOMENTS)
    model = model_of(means, quats, scales, opacities, extinctions, positions, rotations)
    grads = gradients(means, quats, scales, opacities, extinctions)
    grad_seen, grad_total = grad_seen.contiguous(), grad_total.contiguous()
    _native.weights_backward(
        *(means.dtype == torch.float64, poses, n, torch.get_num_threads(), whole, real),
        addresses(*buffers, *model, None, None, grad_seen, grad_total, *grads),
    )
    return filled(grads, means)


def networks(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """`gsparc::networks`."""
    out = encoded.new_empty(encoded.shape[0], weight1.shape[0], weight2.shape[2])
    _networks("networks", *_contiguous(encoded, weight1, bias1, weight2, bias2), out)
    return out


def networks_backward(
    slope: Tensor, encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`gsparc::networks_backward`."""
    inputs = _contiguous(encoded, weight1, bias1, weight2, bias2)
    grads = tuple(torch.empty_like(tensor) for tensor in inputs[1:])
    _networks("networks_backward", *inputs, None, *_contiguous(slope), *grads)
    return grads[0], grads[1], grads[2], grads[3]


def _networks(name: str, encoded: Tensor, weight1: Tensor, *rest: Tensor | None) -> None:
    """Call a kernel on contiguous tensors; rest is bias1, weight2 and what else it takes."""
    (samples, inputs), (count, _, hidden) = encoded.shape, weight1.shape
    weight2 = rest[1]
    assert weight2 is not None
    sizes = (samples, count, inputs, hidden, weight2.shape[2])
    kernel = getattr(_native, name)
    kernel(encoded.dtype == torch.float64, sizes, torch.get_num_threads(), addresses(encoded, weight1, *rest))


def _contiguous(*tensors: Tensor) -> list[Tensor]:
    return [tensor.contiguous() for tensor in tensors]


def similarity(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor]:
    """`gsparc::similarity`."""
    window = torch.tensor(taps, dtype=torch.float32)
    images = [prediction.contiguous(), target.contiguous()]
    value, slopes = prediction.new_empty(len(prediction)), torch.empty_like(images[0]) if slope else None
    sizes = (*prediction.shape, len(taps) // 2)
    tensors = addresses(window, *images, value, slopes)
    _native.similarity(sizes, stability, torch.get_num_threads(), tensors)
    return value, prediction.new_empty(0) if slopes is None else slopes

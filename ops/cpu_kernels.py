"""The operators on CPU tensors, by the C++ kernels.

Kernels receive addresses of tensors, which the caller keeps alive, and torch's number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import _native, validation
from gsparc.ops.geometry import Gaussians
from gsparc.ops.networks import Layers
from gsparc.ops.operators import Buffers, Poses, check_memory, contiguous, empty_like, plan_tensors
from gsparc.ops.settings import KernelSettings


def addresses(*tensors: Tensor | None) -> list[int]:
    """Addresses of tensors; 0 for None."""
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


def _run(kernel: Any, gaussians: Gaussians, poses: Poses, *numbers: Any, tensors: tuple[Any, ...]) -> Any:
    """Call a kernel with sizes, `numbers` and the addresses of `tensors`."""
    means = gaussians.means
    sizes = (means.dtype == torch.float64, len(poses.positions), len(means), torch.get_num_threads())
    return kernel(*sizes, *numbers, addresses(*tensors))


def plan(
    gaussians: Gaussians, ids: Tensor | None, poses: Poses, settings: KernelSettings
) -> tuple[Buffers, Tensor, Tensor, Tensor]:
    """`gsparc::plan`."""
    means = gaussians.means
    buffers, *screen = plan_tensors(means, len(poses.positions), settings.height, 0)
    tensors = (*contiguous((*gaussians, *poses, ids)), *buffers[:-1], *screen)
    validation.raise_for_status(_run(_native.plan, gaussians, poses, settings, tensors=tensors))
    entries = int(buffers.starts[-1])
    check_memory(entries, 4)
    buffers = buffers._replace(entries=means.new_empty(entries, dtype=torch.int32))
    _run(_native.entries, gaussians, poses, settings.height, tensors=buffers)
    return buffers, screen[0], screen[1], screen[2]


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
    tensors = (*buffers, *contiguous((*gaussians, *poses, features)), image, transmittance)
    _run(_native.composite, gaussians, poses, samples, channels, settings, tensors=tensors)
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
    samples, n, channels = features.shape
    per_entry = _native.MOMENTS + (samples * channels if len(poses.positions) == 1 else channels)
    check_memory(len(buffers.entries), features.element_size() * per_entry)
    grads, grad_features = empty_like(gaussians), features.new_empty(features.shape)
    grad_means2d = features.new_empty(len(poses.positions), n, 2)
    images = (image, transmittance, grad_image, grad_transmittance)
    inputs = contiguous((*gaussians, *poses, features, *images))
    tensors = (*buffers, *inputs, *grads, grad_features, grad_means2d)
    _run(_native.composite_backward, gaussians, poses, samples, channels, settings, tensors=tensors)
    return grads, grad_features, grad_means2d


def weights(
    gaussians: Gaussians, poses: Poses, buffers: Buffers, settings: KernelSettings
) -> tuple[Tensor, Tensor]:
    """`gsparc::weights`."""
    seen, total = (gaussians.means.new_empty(len(poses.positions), len(gaussians.means)) for _ in range(2))
    tensors = (*buffers, *contiguous((*gaussians, *poses)), seen, total)
    _run(_native.weights, gaussians, poses, settings, tensors=tensors)
    return seen, total


def weights_backward(
    grad_seen: Tensor,
    grad_total: Tensor,
    gaussians: Gaussians,
    poses: Poses,
    buffers: Buffers,
    settings: KernelSettings,
) -> Gaussians:
    """`gsparc::weights_backward`."""
    check_memory(len(buffers.entries), gaussians.means.element_size() * _native.MOMENTS)
    grads = empty_like(gaussians)
    inputs = contiguous((*gaussians, *poses, None, None, grad_seen, grad_total))
    _run(_native.weights_backward, gaussians, poses, settings, tensors=(*buffers, *inputs, *grads))
    return grads


def networks(encoded: Tensor, layers: Layers) -> Tensor:
    """`gsparc::networks`."""
    out = encoded.new_empty(len(encoded), len(layers.weight1), layers.weight2.shape[2])
    _networks(_native.networks, encoded, layers, out)
    return out


def networks_backward(slope: Tensor, encoded: Tensor, layers: Layers) -> Layers:
    """`gsparc::networks_backward`."""
    grads = empty_like(layers)
    _networks(_native.networks_backward, encoded, layers, None, slope.contiguous(), *grads)
    return grads


def _networks(kernel, encoded: Tensor, layers: Layers, *rest: Tensor | None) -> None:
    (count, inputs, hidden), outputs = layers.weight1.shape, layers.weight2.shape[2]
    sizes = (len(encoded), count, inputs, hidden, outputs)
    tensors = contiguous((encoded, *layers))
    kernel(encoded.dtype == torch.float64, sizes, torch.get_num_threads(), addresses(*tensors, *rest))


def similarity(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor | None]:
    """`gsparc::similarity`."""
    window = torch.tensor(taps, dtype=torch.float32)
    images = [prediction.contiguous(), target.contiguous()]
    value, slopes = prediction.new_empty(len(prediction)), torch.empty_like(images[0]) if slope else None
    sizes = (*prediction.shape, len(taps) // 2)
    tensors = addresses(window, *images, value, slopes)
    _native.similarity(sizes, stability, torch.get_num_threads(), tensors)
    return value, slopes

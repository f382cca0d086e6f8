"""One small network for each Gaussian, evaluated together: E -> H -> C with a ReLU."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.operators import (
    KERNELS,
    call_differentiable,
    contiguous,
    empty_like,
    register_kernel,
    run_kernel,
)
from gsparc.ops.transforms import full_precision, needs_reference


def networks(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """Return outputs (B, N, C) of N networks at B encoded positions; differentiable in every tensor.

    >>> inputs, first, second = torch.ones(5, 4), torch.ones(2, 4, 3), torch.ones(2, 3, 1)
    >>> networks(inputs, first, torch.zeros(2, 3), second, torch.zeros(2, 1))[:, :, 0].shape
    torch.Size([5, 2])

    Args:
        encoded: (B, E), the same for all Gaussians.
        weight1, bias1: (N, E, H), (N, H).
        weight2, bias2: (N, H, C), (N, C).

    Raises:
        ValueError, TypeError: shapes, devices or dtypes that do not fit.
    """
    _check_layers(encoded, Layers(weight1, bias1, weight2, bias2))
    encoded = encoded.to(weight1.dtype)  # it comes in half precision from `torch.autocast`
    if encoded.requires_grad or needs_reference(encoded, weight1, bias1, weight2, bias2):
        return plain_networks(encoded, weight1, bias1, weight2, bias2)
    known = encoded.dtype in (torch.float32, torch.float64)
    # On a GPU products take a few tenths of a millisecond more, below a tenth of a training step.
    if known and "networks" in KERNELS.get(encoded.device.type, ()) and calls.kernels() is not None:
        return call_differentiable(_run_forward, _run_backward, None, encoded, weight1, bias1, weight2, bias2)
    return plain_networks(encoded, weight1, bias1, weight2, bias2)


@full_precision
def plain_networks(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """Return the same (B, N, C) as matrix products; the reference."""
    count, width, hidden = weight1.shape
    # One product for all Gaussians: the encoded position is the same for each of them.
    inner = (encoded @ weight1.permute(1, 0, 2).reshape(width, count * hidden)).view(
        len(encoded), count, hidden
    )
    return torch.einsum("bnh,nhc->bnc", torch.relu(inner + bias1), weight2) + bias2


class Layers(NamedTuple):
    """The weights and biases of `networks`."""

    weight1: Tensor
    bias1: Tensor
    weight2: Tensor
    bias2: Tensor


def _run_forward(_: None, encoded: Tensor, *weights: Tensor) -> Tensor:
    layers = Layers(*weights)
    out = encoded.new_empty(len(encoded), len(layers.weight1), layers.weight2.shape[2])
    return run_kernel("networks", encoded, out, encoded, layers)


def _run_backward(_: None, slope: Tensor, encoded: Tensor, *weights: Tensor) -> tuple[Tensor | None, ...]:
    layers = Layers(*weights)
    return None, *run_kernel("networks_backward", encoded, empty_like(layers), slope, encoded, layers)


@register_kernel("networks", "cpu")
def _networks(out: Tensor, encoded: Tensor, layers: Layers) -> None:
    if out.numel():
        calls.launch("networks", encoded, *contiguous((encoded, *layers)), out, sizes=_sizes(encoded, layers))


@register_kernel("networks_backward", "cpu")
def _networks_backward(out: Layers, slope: Tensor, encoded: Tensor, layers: Layers) -> None:
    if slope.numel():
        tensors = (*contiguous((encoded, *layers, slope)), *out)
        calls.launch("networks_backward", encoded, *tensors, sizes=_sizes(encoded, layers))
    else:
        for gradient in out:
            gradient.zero_()


def _check_layers(encoded: Tensor, layers: Layers) -> None:
    """What a kernel reads by address alone (ValueError, TypeError)."""
    first, bias1, second, bias2 = layers
    fits = encoded.dim() == 2 and first.dim() == second.dim() == 3
    if fits:
        (count, inputs, hidden), outputs = first.shape, second.shape[2]
        wanted = (inputs, (count, hidden), (count, hidden, outputs), (count, outputs))
        fits = (encoded.shape[1], bias1.shape, second.shape, bias2.shape) == wanted
    if not fits or not encoded.device == first.device == bias1.device == second.device == bias2.device:
        actual = ", ".join(f"{tuple(part.shape)} on {part.device}" for part in (encoded, *layers))
        raise ValueError(
            "encoded (B, E), weights (N, E, H) and (N, H, C) with biases (N, H) and (N, C) are needed "
            f"on one device, got {actual}"
        )
    alike = first.dtype == bias1.dtype == second.dtype == bias2.dtype
    if not alike or (encoded.dtype != first.dtype and not torch.is_autocast_enabled(encoded.device.type)):
        actual = ", ".join(str(part.dtype) for part in (encoded, *layers))
        raise TypeError(f"encoded, weights and biases share a dtype, got {actual}; convert one of them")


def _sizes(encoded: Tensor, layers: Layers) -> tuple[int, ...]:
    return len(encoded), *layers.weight1.shape, layers.weight2.shape[2]

"""One small network for each Gaussian, evaluated together: E -> H -> C with a ReLU."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.library import custom_op

from gsparc.ops import backends, built
from gsparc.ops.operators import KERNELS

MOST_INPUTS, MOST_OUTPUTS = 256, 4  # of the CUDA kernels, whose weights pass through registers


def networks(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """Outputs (B, N, C) of N networks at B encoded positions; differentiable in every tensor.

    Args:
        encoded: (B, E), the same for all Gaussians.
        weight1, bias1: (N, E, H), (N, H).
        weight2, bias2: (N, H, C), (N, C).
    """
    if encoded.requires_grad or encoded.dtype != weight1.dtype:
        return products(encoded, weight1, bias1, weight2, bias2)
    fits = encoded.dtype in (torch.float32, torch.float64) and built.kernels() is not None
    if encoded.is_cuda:
        fits = encoded.dtype == torch.float32
        fits &= weight1.shape[1] <= MOST_INPUTS and weight2.shape[2] <= MOST_OUTPUTS
    if fits:
        backends.named(encoded.device.type)  # its kernels are then in the table
        return networks_op(encoded, weight1, bias1, weight2, bias2)
    return products(encoded, weight1, bias1, weight2, bias2)


def products(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """The same (B, N, C) as matrix products; the definition of truth."""
    count, width, hidden = weight1.shape
    # One product for all Gaussians: the encoded position is the same for each of them.
    inner = (encoded @ weight1.permute(1, 0, 2).reshape(width, count * hidden)).view(
        len(encoded), count, hidden
    )
    return torch.einsum("bnh,nhc->bnc", torch.relu(inner + bias1), weight2) + bias2


@custom_op("gsparc::networks", mutates_args=())
def networks_op(encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """`networks`, without a gradient for `encoded`."""
    return KERNELS[encoded.device.type].networks(encoded, weight1, bias1, weight2, bias2)


@networks_op.register_fake
def _(encoded, weight1, bias1, weight2, bias2):
    return encoded.new_empty(encoded.shape[0], weight1.shape[0], weight2.shape[2])


@custom_op("gsparc::networks_backward", mutates_args=())
def networks_backward_op(
    slope: Tensor, encoded: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of weight1, bias1, weight2, bias2 for the gradient `slope` (B, N, C) of the outputs."""
    return KERNELS[encoded.device.type].networks_backward(slope, encoded, weight1, bias1, weight2, bias2)


@networks_backward_op.register_fake
def _(slope, encoded, weight1, bias1, weight2, bias2):
    shapes = (weight1.shape, bias1.shape, weight2.shape, bias2.shape)
    return tuple(slope.new_empty(shape) for shape in shapes)


def _setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _backward(ctx, slope):
    return None, *networks_backward_op(slope, *ctx.saved_tensors)


networks_op.register_autograd(_backward, setup_context=_setup)

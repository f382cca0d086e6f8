"""Channels of many antennas and subcarriers from sources with a gain, a steering vector and a delay each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.library import custom_op

from gsparc.ops import built


def channels(
    gains: Tensor, steering: Tensor, delays: Tensor, first_hz: float, step_hz: float, subcarriers: int
) -> Tensor:
    """H[b, a, k] = sum_n gains[b, n] steering[n, a] exp(-j 2 pi f_k delays[n]), f_k = first + k step.

    Complex numbers are pairs of real ones on the last axis; differentiable in every tensor.

    Args:
        gains: (B, N, 2), float32 or float64.
        steering: (N, A, 2), the same.
        delays: (N,) float64 [s]: in float32 the phase of a carrier is lost within a few hundred metres.
        first_hz, step_hz: first frequency and spacing of the subcarriers [Hz].
        subcarriers: how many, K.

    Returns:
        (B, A, K, 2).

    Raises:
        ValueError, TypeError: shapes or dtypes that do not fit.
    """
    count, antennas = steering.shape[:2]
    if gains.shape[1:] != (count, 2) or steering.shape != (count, antennas, 2) or delays.shape != (count,):
        raise ValueError(
            f"gains (B, N, 2), steering (N, A, 2) and delays (N,) are needed, "
            f"got {tuple(gains.shape)}, {tuple(steering.shape)}, {tuple(delays.shape)}"
        )
    if gains.dtype != steering.dtype or delays.dtype != torch.float64:
        raise TypeError(
            f"gains and steering share a dtype and delays are float64, "
            f"got {gains.dtype}, {steering.dtype}, {delays.dtype}"
        )
    tones = [first_hz, step_hz]
    single = gains.dtype in (torch.float32, torch.float64)
    if gains.device.type == "cpu" and single and built.kernels() is not None:
        return channels_op(gains, steering, delays, tones, subcarriers)
    return summed(gains, steering, delays, tones, subcarriers)


def summed(
    gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float], subcarriers: int
) -> Tensor:
    """The same (B, A, K, 2) in plain PyTorch; the reference. `tones`: first and spacing [Hz]."""
    numbers = torch.arange(subcarriers, dtype=torch.float64, device=gains.device)
    turns = torch.outer(delays, tones[0] + tones[1] * numbers)
    phase = -2 * math.pi * (turns - turns.detach().floor())
    factor = torch.polar(torch.ones_like(phase), phase).to(
        torch.view_as_complex(gains[:0].contiguous()).dtype
    )
    weights = torch.view_as_complex(gains.contiguous()), torch.view_as_complex(steering.contiguous())
    return torch.view_as_real(torch.einsum("bn,na,nk->bak", *weights, factor).contiguous())


@custom_op("gsparc::channels", mutates_args=(), device_types="cpu")
def channels_op(
    gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float], subcarriers: int
) -> Tensor:
    """`channels` by the CPU kernel."""
    out = gains.new_empty(gains.shape[0], steering.shape[1], subcarriers, 2)
    _run("channels", tones, subcarriers, gains.contiguous(), steering.contiguous(), delays.contiguous(), out)
    return out


@channels_op.register_fake
def _(gains, steering, delays, tones, subcarriers):
    return gains.new_empty(gains.shape[0], steering.shape[1], subcarriers, 2)


@custom_op("gsparc::channels_backward", mutates_args=(), device_types="cpu")
def channels_backward_op(
    slope: Tensor, gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of gains, steering and delays for the gradient `slope` (B, A, K, 2) of the channels."""
    inputs = [tensor.contiguous() for tensor in (gains, steering, delays)]
    grads = [torch.empty_like(tensor) for tensor in inputs]
    _run("channels_backward", tones, slope.shape[2], *inputs, None, slope.contiguous(), *grads)
    return grads[0], grads[1], grads[2]


@channels_backward_op.register_fake
def _(slope, gains, steering, delays, tones):
    return tuple(tensor.new_empty(tensor.shape) for tensor in (gains, steering, delays))


def _run(name: str, tones: Sequence[float], subcarriers: int, gains: Tensor, *rest: Tensor | None) -> None:
    steering = rest[0]
    assert steering is not None
    sizes = (*gains.shape[:2], steering.shape[1], subcarriers)
    tensors = [0 if tensor is None else tensor.data_ptr() for tensor in (gains, *rest)]
    kernel = getattr(built.kernels(), name)
    kernel(gains.dtype == torch.float64, sizes, tones, torch.get_num_threads(), tensors)


def _setup(ctx, inputs, output):
    gains, steering, delays, ctx.tones, _ = inputs
    ctx.save_for_backward(gains, steering, delays)


def _backward(ctx, slope):
    return *channels_backward_op(slope, *ctx.saved_tensors, ctx.tones), None, None


channels_op.register_autograd(_backward, setup_context=_setup)

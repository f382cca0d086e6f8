"""Channels of many antennas and subcarriers from sources with a gain, a steering vector and a delay each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import built, calls
from gsparc.ops.operators import KERNELS, contiguous, kernel, operator
from gsparc.ops.transforms import beyond_kernels


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
    known = gains.dtype in (torch.float32, torch.float64)
    if not known or gains.dtype != steering.dtype or delays.dtype != torch.float64:
        raise TypeError(
            f"gains and steering are both float32 or both float64 and delays are float64, "
            f"got {gains.dtype}, {steering.dtype}, {delays.dtype}"
        )
    if subcarriers < 0:
        raise ValueError(f"{subcarriers} subcarriers are none: give 0 or more")
    tones = [first_hz, step_hz]
    served = not beyond_kernels(gains, steering, delays)
    if served and built.kernels() is not None and "channels" in KERNELS.get(gains.device.type, ()):
        return channels_op.of(gains, steering, delays, tones, subcarriers)
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


@operator
def channels_op(
    gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float], subcarriers: int
) -> Tensor:
    """`channels` by the CPU kernel."""
    return gains.new_empty(gains.shape[0], steering.shape[1], subcarriers, 2)


@operator
def channels_backward_op(
    slope: Tensor, gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of gains, steering and delays for the gradient `slope` (B, A, K, 2) of the channels."""
    return gains.new_empty(gains.shape), steering.new_empty(steering.shape), delays.new_empty(delays.shape)


@kernel("channels", "cpu")
def _channels(
    out: Tensor, gains: Tensor, steering: Tensor, delays: Tensor, tones: Any, subcarriers: int
) -> None:
    sizes = (*gains.shape[:2], steering.shape[1], subcarriers)
    inputs = contiguous((gains, steering, delays))
    calls.run("channels", gains, *inputs, out, sizes=sizes, numbers=tones)


@kernel("channels_backward", "cpu")
def _channels_backward(
    out: Any, slope: Tensor, gains: Tensor, steering: Tensor, delays: Tensor, tones: Any
) -> None:
    sizes = (*gains.shape[:2], steering.shape[1], slope.shape[2])
    inputs = contiguous((gains, steering, delays, slope))
    calls.run("channels_backward", gains, *inputs, *out, sizes=sizes, numbers=tones)


def _setup(ctx, inputs, output):
    gains, steering, delays, ctx.tones, _ = inputs
    ctx.save_for_backward(gains, steering, delays)


def _backward(ctx, slope):
    return *channels_backward_op(slope, *ctx.saved_tensors, ctx.tones), None, None


channels_op.register_autograd(_backward, setup_context=_setup)

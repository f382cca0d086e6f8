"""Channels of many antennas and subcarriers from sources with a gain, a steering vector and a delay each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.operators import KERNELS, call_differentiable, contiguous, register_kernel, run_kernel
from gsparc.ops.transforms import needs_reference


def channels(
    gains: Tensor, steering: Tensor, delays: Tensor, first_hz: float, step_hz: float, subcarriers: int
) -> Tensor:
    """Sum H[b, a, k] = sum_n gains[b, n] steering[n, a] exp(-j 2 pi f_k delays[n]), f_k = first + k step.

    Complex numbers are pairs of real ones on the last axis; differentiable in every tensor.

    >>> gains = torch.tensor([[[1.0, 0.0], [0.5, 0.0]]])  # of two paths, real
    >>> steering = torch.tensor([1.0, 0.0]).expand(2, 1, 2)  # of one antenna
    >>> delays = torch.tensor([0.0, 50e-9], dtype=torch.float64)
    >>> channels(gains, steering, delays, 0.0, 10e6, 2)[0, 0, :, 0]  # in phase, then half a turn apart
    tensor([1.5000, 0.5000])

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
    served = not needs_reference(gains, steering, delays)
    if served and calls.kernels() is not None and "channels" in KERNELS.get(gains.device.type, ()):
        return call_differentiable(_run_forward, _run_backward, (tones, subcarriers), gains, steering, delays)
    return plain_channels(gains, steering, delays, tones, subcarriers)


def plain_channels(
    gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float], subcarriers: int
) -> Tensor:
    """Return the same (B, A, K, 2) in plain PyTorch; the reference. `tones`: first and spacing [Hz]."""
    numbers = torch.arange(subcarriers, dtype=torch.float64, device=gains.device)
    turns = torch.outer(delays, tones[0] + tones[1] * numbers)
    # Whole turns go first: 2 pi times 1e6 turns would round six digits of the phase away.
    phase = -2 * math.pi * (turns - turns.detach().floor())
    # Sines of a float64 phase; products in the precision of the gains.
    factor = torch.polar(torch.ones_like(phase), phase).to(
        torch.view_as_complex(gains[:0].contiguous()).dtype
    )
    weights = torch.view_as_complex(gains.contiguous()), torch.view_as_complex(steering.contiguous())
    return torch.view_as_real(torch.einsum("bn,na,nk->bak", *weights, factor).contiguous())


def _run_forward(fixed: Any, gains: Tensor, steering: Tensor, delays: Tensor) -> Tensor:
    tones, subcarriers = fixed
    out = gains.new_empty(len(gains), steering.shape[1], subcarriers, 2)
    return run_kernel("channels", gains, out, gains, steering, delays, tones)


def _run_backward(fixed: Any, slope: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    out = tuple(part.new_empty(part.shape) for part in inputs)
    return run_kernel("channels_backward", slope, out, slope, *inputs, fixed[0])


@register_kernel("channels", "cpu")
def _channels(out: Tensor, gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float]) -> None:
    sizes = (*gains.shape[:2], *out.shape[1:3])
    calls.launch("channels", gains, *contiguous((gains, steering, delays)), out, sizes=sizes, numbers=tones)


@register_kernel("channels_backward", "cpu")
def _channels_backward(
    out: Any, slope: Tensor, gains: Tensor, steering: Tensor, delays: Tensor, tones: Sequence[float]
) -> None:
    sizes = (*gains.shape[:2], *slope.shape[1:3])
    inputs = contiguous((gains, steering, delays, slope))
    calls.launch("channels_backward", gains, *inputs, *out, sizes=sizes, numbers=tones)

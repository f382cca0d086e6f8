"""Spherical waves `exp(-j 2 pi f r / c) / r` whose phase is right at any range and carrier.

A phase is a range in wavelengths without its whole part. Ten kilometres at 60 GHz are two million
wavelengths: float32 keeps no fraction of them, float64 keeps nine digits. So ranges stay float64 until the
whole part is gone, and only then become float32.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LIGHT = 299_792_458.0  # [m/s]
NEAR_M = 0.001  # no receiver comes closer to a source; keeps 1/r and its slope finite


def ranges(observers: Tensor, sources: Tensor) -> Tensor:
    """Ranges (n, K) float64 [m] between observers (n, 3) and sources (K, 3) [m], at least `NEAR_M`.

    Sources (n, K, 3) are each observer's own.
    """
    offset = observers.double()[:, None, :] - sources.double()
    return (offset.square().sum(-1) + NEAR_M**2).sqrt()


def reduced_phase(
    distance: Tensor, frequency_hz: Tensor | float, dtype: torch.dtype = torch.float32
) -> Tensor:
    """`-2 pi f r / c` brought into [-pi, pi] in float64, then cast.

    Args:
        distance: (...) [m]; made float64. Its gradient is that of the unreduced phase.
        frequency_hz: broadcasts against `distance` [Hz].
        dtype: of the result.

    Returns:
        (...) [rad].
    """
    cycles = distance.double() * (_double(frequency_hz, distance) / LIGHT)
    return ((cycles.detach().round() - cycles) * (2 * math.pi)).to(dtype)


def wave(distance: Tensor, frequency_hz: Tensor | float, dtype: torch.dtype = torch.float32) -> Tensor:
    """`exp(-j 2 pi f r / c) / r` of parts `dtype`; distances [m] and frequencies [Hz] broadcast."""
    return torch.polar((1 / distance).to(dtype), reduced_phase(distance, frequency_hz, dtype))


def wave_over_band(distance: Tensor, frequency_hz: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """The same at every one of F frequencies: (...) [m], (F,) [Hz] -> (..., F).

    Evenly spaced tones are factored into a coarse and a fine comb, `f = f_0 + (q M + p) df`: about
    2 sqrt(F) sines and cosines instead of F, and one product per tone; 1/r enters with the coarse comb.
    """
    frequency = _double(frequency_hz, distance)
    tones = len(frequency)
    if tones < 6 or not evenly_spaced(frequency):
        return wave(distance[..., None], frequency, dtype)
    fine = math.isqrt(tones - 1) + 1
    coarse = wave(distance[..., None], frequency[::fine], dtype)
    steps = frequency[:fine] - frequency[0]
    turn = reduced_phase(distance[..., None], steps, dtype)
    comb = torch.polar(torch.ones_like(turn), turn)
    return (coarse[..., :, None] * comb[..., None, :]).flatten(-2)[..., :tones]


def evenly_spaced(frequency: Tensor) -> bool:
    """Whether tones (F,) [Hz] are a comb."""
    step = frequency.diff()
    # A thousandth of a radian over a kilometre of range: 50 Hz
    return bool(((step - step.mean()).abs().cumsum(0) < 50.0).all())


def _double(value: Tensor | float, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device=like.device)

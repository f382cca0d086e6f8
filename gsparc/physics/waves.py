"""Spherical waves `exp(-j 2 pi f r / c) / r` whose phase is right at any range and carrier.

A phase is a range in wavelengths without its whole part. Ten kilometres at 60 GHz are two million
wavelengths: float32 keeps no fraction of them, float64 keeps nine digits. So ranges stay float64
until the whole part is gone, and only then become float32.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LIGHT = 299_792_458.0  # [m/s]
NEAR_M = 0.001  # no receiver comes closer to a source; keeps 1/r and its slope finite


def ranges(observers: Tensor, sources: Tensor) -> Tensor:
    """Return ranges (n, K) float64 [m] between observers (n, 3) and sources (K, 3) [m],
    at least `NEAR_M`.

    Sources (n, K, 3) are each observer's own.

    >>> ranges(torch.zeros(1, 3), torch.tensor([[3.0, 4.0, 0.0]])).round(decimals=3)
    tensor([[5.]], dtype=torch.float64)
    """
    offset = observers.double()[:, None, :] - sources.double()
    return (offset.square().sum(-1) + NEAR_M**2).sqrt()


def reduced_phase(
    distance: Tensor, frequency_hz: Tensor | float, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Return `-2 pi f r / c` brought into [-pi, pi] in float64, then cast.

    Two wavelengths of 1 m and a quarter:

    >>> reduced_phase(torch.tensor(2.25, dtype=torch.float64), LIGHT)
    tensor(-1.5708)

    Args:
        distance: (...) [m]; made float64. Its gradient is that of the unreduced phase.
        frequency_hz: broadcasts against `distance` [Hz].
        dtype: of the result.

    Returns:
        (...) [rad].
    """
    cycles = distance.double() * (_to_float64(frequency_hz, distance) / LIGHT)
    # Whole turns have no slope, so that the gradient is that of the phase before they went.
    return ((cycles.detach().round() - cycles) * (2 * math.pi)).to(dtype)


def point_wave(
    distance: Tensor, frequency_hz: Tensor | float, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Return `exp(-j 2 pi f r / c) / r` of parts `dtype`;
    distances [m] and frequencies [Hz] broadcast.

    >>> point_wave(torch.tensor([2.0, 4.0]), LIGHT).real  # whole wavelengths of 1 m
    tensor([0.5000, 0.2500])
    """
    return torch.polar((1 / distance).to(dtype), reduced_phase(distance, frequency_hz, dtype))


def wave_over_band(
    distance: Tensor, frequency_hz: Tensor, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Return the same at every one of F frequencies: (...) [m], (F,) [Hz] -> (..., F).

    Evenly spaced tones are factored into a coarse and a fine comb, `f = f_0 + (q M + p) df`: about
    2 sqrt(F) sines and cosines instead of F, and one product per tone;
    1/r enters with the coarse comb.

    >>> wave_over_band(torch.tensor([3.0, 5.0]), torch.linspace(2.40e9, 2.42e9, 64)).shape
    torch.Size([2, 64])
    """
    frequency = _to_float64(frequency_hz, distance)
    tones = len(frequency)
    if tones < 6 or not is_comb(frequency):
        return point_wave(distance[..., None], frequency, dtype)
    # The root of the number of tones, rounded up: both combs together are then as short as can be.
    fine = math.isqrt(tones - 1) + 1
    coarse = point_wave(distance[..., None], frequency[::fine], dtype)
    steps = frequency[:fine] - frequency[0]
    turn = reduced_phase(distance[..., None], steps, dtype)
    comb = torch.polar(torch.ones_like(turn), turn)
    return (coarse[..., :, None] * comb[..., None, :]).flatten(-2)[..., :tones]


def is_comb(frequency: Tensor) -> bool:
    """Tell whether tones (F,) [Hz] are a comb.

    >>> is_comb(torch.tensor([0.0, 1e6, 2e6])), is_comb(torch.tensor([0.0, 1e6, 3e6]))
    (True, False)
    """
    step = frequency.diff()
    # A thousandth of a radian over a kilometre of range: 50 Hz
    return bool(((step - step.mean()).abs().cumsum(0) < 50.0).all())


def _to_float64(value: Tensor | float, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device=like.device)

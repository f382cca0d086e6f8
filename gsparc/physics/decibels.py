"""Powers in decibels, and back."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Values = TypeVar("Values", np.ndarray, Tensor)
Powers = TypeVar("Powers", np.ndarray, Tensor, float)
RELATIVE_DB = 10 / math.log(10)  # decibels of a small relative change of a power
TINY_POWER = 1e-30  # -300 dB; only so that a logarithm exists


def to_decibels(power: Powers) -> Powers:
    """Return levels (...) [dB] of powers (...).

    >>> to_decibels(np.array([1.0, 100.0]))
    array([ 0., 20.])
    """
    return 10 * (torch.log10(power) if isinstance(power, Tensor) else np.log10(power))


def from_decibels(level: Powers) -> Powers:
    """Return powers (...) of levels (...) [dB].

    >>> from_decibels(np.array([0.0, 20.0]))
    array([  1., 100.])
    """
    return 10 ** (level / 10)


def finite_decibels(power: Values) -> Values:
    """Return levels (...) [dB] of powers (...), of none the least that has a logarithm.

    >>> finite_decibels(np.array([0.0, 100.0]))
    array([-300.,   20.])
    """
    if isinstance(power, Tensor):
        return to_decibels(power.clamp_min(TINY_POWER))
    return to_decibels(np.maximum(power, power.dtype.type(TINY_POWER)))

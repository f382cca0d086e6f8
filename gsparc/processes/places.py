"""Columns of places: one end [m], then the other end where both are told, then what else is."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Places = TypeVar("Places", np.ndarray, Tensor)

ORIGIN = torch.zeros(3, dtype=torch.float64)
NO_PLACES = ORIGIN.new_zeros(0, len(ORIGIN))
UNKNOWN = torch.full_like(ORIGIN, math.nan)  # a place that nobody gave


def first_end(places: Places) -> Places:
    """Return the first end (..., 3) of places (..., D) [m]: the one that moves,
    or of two the transmitter.

    >>> first_end(np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 9.0]]))
    array([[1., 2., 3.]])
    """
    return places[..., :3]


def other_end(places: Places) -> Places:
    """Return the second end (..., 3) of places (..., D) of both [m]; nothing (..., 0) of one.

    >>> other_end(np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 9.0]]))
    array([[0., 0., 9.]])
    """
    return places[..., 3:6]


def extra_columns(places: Places) -> Places:
    """Return what else than both ends (..., D - 6) tells rows of places (..., D)."""
    return places[..., 6:]


def has_both_ends(places: np.ndarray | Tensor) -> bool:
    """Tell whether places (..., D) are of both ends."""
    return places.shape[-1] > len(ORIGIN)


def horizontal(points: Places) -> Places:
    """Return horizontal coordinates (..., 2) of points (..., 3) [m]."""
    return points[..., :2]

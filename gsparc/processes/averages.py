"""Means of what was measured at one place, and of what members of a mixture say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor


class PlaceMeans(NamedTuple):
    """Means at places: the first row (m,) of each, means (m, ...) and numbers of rows (m,)."""

    first: np.ndarray
    mean: np.ndarray
    rows: np.ndarray


class MeanVariance(NamedTuple):
    """Mean (n, ...) and variance (n,)."""

    mean: Tensor
    variance: Tensor


def mean_at_places(
    places: np.ndarray, values: np.ndarray, measured: np.ndarray | None = None
) -> PlaceMeans:
    """Average rows over each of their places;
    rows of places that are all different stay as they are.

    >>> places, values = np.array([[5.0], [2.0], [5.0]]), np.array([1.0, 8.0, 3.0])
    >>> first, mean, count = mean_at_places(places, values)
    >>> first, mean, count
    (array([1, 0]), array([8., 2.]), array([1, 2]))

    Args:
        places: (n, D); any columns may stand beside positions that tell rows apart.
        values: (n, ...) real or complex.
        measured: (n, ...) bool, entries that count; None: all.

    Returns:
        See `PlaceMeans`; means are 0 where nothing was measured.
    """
    _, first, place, count = np.unique(places, True, True, True, axis=0)
    if len(first) == len(places):  # nothing to copy
        return PlaceMeans(np.arange(len(places)), values, count)
    flat, kind = values.reshape(len(values), -1), values.real.dtype
    members = csr_array((np.ones(len(places), kind), (place.reshape(-1), np.arange(len(places)))))
    heard = count[:, None] if measured is None else members @ measured.reshape(flat.shape)
    total = members @ (
        flat if measured is None else np.where(measured.reshape(flat.shape), flat, 0)
    )
    mean = total / np.maximum(heard, 1).astype(kind)
    return PlaceMeans(first, mean.reshape(-1, *values.shape[1:]), count)


def mixture_moments(parts: Sequence[tuple[float, Tensor, Tensor]]) -> MeanVariance:
    """Return mean (n, ...) and variance (n,) of a mixture of shares, means (n, ...)
    and variances (n,).

    What the members disagree about is part of the variance,
    mean over entries (law of total variance).

    >>> one, two = torch.tensor([-70.0]), torch.tensor([-80.0])
    >>> mixture_moments([(0.5, one, torch.tensor([4.0])), (0.5, two, torch.tensor([4.0]))])
    MeanVariance(mean=tensor([-75.]), variance=tensor([29.]))
    """
    if len(parts) == 1:
        return MeanVariance(*parts[0][1:])
    mean = torch.stack([share * mean_of_part for share, mean_of_part, _ in parts]).sum(0)
    entries = math.prod(mean.shape[1:])
    deviations = (
        (part - mean).abs().square().reshape(len(mean), entries).mean(1) for _, part, _ in parts
    )
    spread = [
        share * (variance + off)
        for (share, _, variance), off in zip(parts, deviations, strict=True)
    ]
    return MeanVariance(mean, torch.stack(spread).sum(0))

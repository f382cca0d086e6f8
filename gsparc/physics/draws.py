"""Random places and sizes to start searches from."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def sample_in_box(low: Tensor, high: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw places (count, D), uniform between corners (D,), of their dtype.

    >>> sample_in_box(torch.zeros(3), torch.ones(3), 2, torch.Generator().manual_seed(0)).shape
    torch.Size([2, 3])
    """
    share = torch.rand(count, len(low), generator=generator, dtype=low.dtype)
    return low + (high - low) * share


def sample_log_uniform(
    shortest: float, longest: float, like: Tensor, generator: torch.Generator
) -> Tensor:
    """Draw log-uniform lengths of the shape and dtype of `like`, as sizes of things are.

    >>> sides = sample_log_uniform(0.1, 1.0, torch.zeros(5, 3), torch.Generator())
    >>> bool((sides >= 0.1).all() and (sides <= 1).all())
    True
    """
    share = torch.rand(like.shape, generator=generator, dtype=like.dtype)
    return shortest * torch.exp(share * math.log(longest / shortest))

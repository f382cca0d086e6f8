"""Visibility kernel: covariance of a source's gain over places.

Sources do not occlude each other: each has its own gain process, and all share the kernel's parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class View:
    """Places and their directions from one source.

    Attributes:
        place: (n, 3) float64 [m], relative to the middle of the scene.
        direction: (n, 3) float32, unit vectors from the source to the places.
    """

    place: Tensor
    direction: Tensor

    @staticmethod
    def of(places: Tensor, source: Tensor) -> View:
        """From float64 places (n, 3) and a source (3,) [m]."""
        offset = places - source
        length = torch.linalg.vector_norm(offset, dim=-1, keepdim=True).clamp_min(1e-6)
        return View(places, (offset / length).float())


ROUNDED = 1e-3  # of a squared length, largest rounding error of a squared distance


@dataclass(frozen=True)
class KernelVisibility:
    """`c + (1 - c) Matern-3/2(direction, place)`: a constant gain plus one that varies smoothly.

    Attributes:
        constant: share of the gain's variance that is the same everywhere.
        angle: length scale of the direction to the source [rad].
        length: length scale of the place [m].
    """

    constant: float | Tensor = 0.8
    angle: float | Tensor = 0.5
    length: float | Tensor = 2.0

    def correlation(self, first: View, second: View) -> Tensor:
        """(n, m) float32 in [0, 1], one where both places are the same."""
        squared = _squared(first.direction, second.direction) / self.angle**2
        places = (first.place, second.place)
        if not _is_wide(*places, float(torch.as_tensor(self.length).detach())):
            places = (first.place.float(), second.place.float())
        squared = squared + _squared(*places).float() / self.length**2
        return self.constant + (1 - self.constant) * matern32(squared)


def matern32(squared: Tensor) -> Tensor:
    """Matern-3/2 of squared distances (...) in units of the length; like them."""
    root = (3 * squared + 1e-9).sqrt()
    return (1 + root) * torch.exp(-root)


def _is_wide(first: Tensor, second: Tensor, length: float) -> bool:
    """Whether squared distances need float64: of 5 km those in float32 are off by a square metre.

    Elsewhere float64 would only double the time of a search.
    """
    reach = max(float(places.abs().max()) if places.numel() else 0.0 for places in (first, second))
    return torch.finfo(torch.float32).eps * reach**2 > ROUNDED * length**2


def _squared(a: Tensor, b: Tensor) -> Tensor:
    return (a.square().sum(-1)[:, None] + b.square().sum(-1)[None] - 2 * a @ b.T).clamp_min(0)

"""Visibility kernel: covariance of a source's gain over places.

Sources do not occlude each other: each has its own gain process, and all share the kernel's parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.processes.kernel import matern32_of_squares

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

    def correlation(self, places: Tensor, source: Tensor) -> Tensor:
        """(n, n) float32 in [0, 1] of the gains of a source (3,) [m] at places (n, 3) float64 [m].

        By reciprocity gains also vary over places of the static end, the last three of (n, 6) numbers.
        """
        squared = _squared(directions(places[:, :3], source)) / self.angle**2
        if not _is_wide(places, float(torch.as_tensor(self.length).detach())):
            places = places.float()
        squared = squared + _squared(places).float() / self.length**2
        return self.constant + (1 - self.constant) * matern32_of_squares(squared)

    @staticmethod
    def of(value: Tensor) -> KernelVisibility:
        """From the logit of `constant` and the logarithms of both lengths; differentiable."""
        return KernelVisibility(torch.sigmoid(value[0]), value[1].exp(), value[2].exp())

    def parameters(self, least: float, *shares: float) -> Tensor:
        """Inverse of `of`, then the logits of more `shares`; all shares are at least `least`."""
        clipped = [min(max(float(share), least), 0.995) for share in (self.constant, *shares)]
        first, *rest = (math.log(share / (1 - share)) for share in clipped)
        return torch.tensor([first, math.log(self.angle), math.log(self.length), *rest])

    def plain(self) -> KernelVisibility:
        """With numbers instead of tensors."""
        return KernelVisibility(float(self.constant), float(self.angle), float(self.length))


def directions(places: Tensor, sources: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Unit vectors (..., n, 3) from sources (..., 3) to places (n, 3) float64 [m]."""
    offset = places - sources[..., None, :]
    return (offset / torch.linalg.vector_norm(offset, dim=-1, keepdim=True).clamp_min(1e-6)).to(dtype)


def _is_wide(places: Tensor, length: float) -> bool:
    """Whether squared distances need float64: of 5 km those in float32 are off by a square metre.

    Elsewhere float64 would only double the time of a search.
    """
    reach = float(places.abs().max()) if places.numel() else 0.0
    return torch.finfo(torch.float32).eps * reach**2 > ROUNDED * length**2


def _squared(a: Tensor) -> Tensor:
    length = a.square().sum(-1)
    return (length[:, None] + length[None] - 2 * a @ a.T).clamp_min(0)

"""Fewer pixels: render every n-th row and column, fill in the rest by linear interpolation."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.method import Method, Prediction
from gsparc.models.reduced import View
from gsparc.ops import Pose, SphereGrid


def coarser(grid: SphereGrid, stride: int) -> SphereGrid:
    """Every `stride`-th pixel of the grid, the first row and column among them.

    Raises:
        ValueError: the columns cannot be divided so.
    """
    if grid.width % stride:
        raise ValueError(f"stride={stride} does not divide the {grid.width} columns of the grid")
    height, width = (grid.height - 1) // stride + 1, grid.width // stride
    steps = {"elevation_step": grid.elevation_step * stride, "azimuth_step": grid.azimuth_step * stride}
    return replace(grid, height=height, width=width, **steps)


class Filled(View):
    """A method that answers on a coarser grid, its images interpolated to the full one.

    Args:
        inner: answers on `coarser(grid, stride)`.
        grid: the full one.
        stride: pixels per rendered pixel, along both axes.
    """

    def __init__(self, inner: Method, grid: SphereGrid, stride: int) -> None:
        super().__init__(inner)
        self.grid, self.stride = grid, stride
        height, width = (grid.height - 1) // stride + 1, grid.width // stride
        self._height = grid.height
        self._below = torch.arange(1, height + 1).clamp_max(height - 1)  # rows past the last repeat it
        self._next = torch.arange(1, width + 1)
        self._next[-1] = 0 if grid.periodic else width - 1
        self._between = torch.arange(stride) / stride

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`; images (B, H, W) of the full grid."""
        found = self.inner.predict(tx, rx)
        return Prediction(self.fill(found.mean), found.confidence, found.variance)

    def fill(self, image: Tensor) -> Tensor:
        """(B, h, w) -> (B, H, W)."""
        beside = image.index_select(2, self._next)
        wide = torch.lerp(image[..., None], beside[..., None], self._between).flatten(2)
        below = wide.index_select(1, self._below)
        tall = torch.lerp(wide[:, :, None], below[:, :, None], self._between[:, None])
        return tall.flatten(1, 2)[:, : self._height]

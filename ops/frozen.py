"""A static receiver at inference: everything but the emission, frozen to one sparse matrix."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.ops.geometry import SphereGrid


class StalePlan(RuntimeError):
    """The field has changed since its view was frozen."""


@dataclass(frozen=True)
class FrozenPlan:
    """Compositing weights of one pose.

    Attributes:
        weights: (H W, V), sparse or dense; alpha times transmittance of the Gaussians in `order`.
        order: (V,) rows of the features, the Gaussians that this receiver sees.
        grid: directions of the pixels.
        version: the field's own counter at the time of freezing.
    """

    weights: Tensor
    order: Tensor
    grid: SphereGrid
    version: int

    def render(self, features: Tensor, version: int) -> Tensor:
        """Image (C, H, W) of features (N, C), or (B, C, H, W) of (B, N, C); not differentiable.

        Raises:
            StalePlan: if `version`, the field's counter now, is not the one this view was made from.
        """
        if version != self.version:
            raise StalePlan(
                f"this view was frozen at version {self.version}, the field is at {version}: freeze again"
            )
        batched = features.dim() == 3
        batch = features if batched else features.unsqueeze(0)
        samples, _, channels = batch.shape
        with torch.no_grad():
            columns = batch[:, self.order].permute(1, 0, 2).reshape(len(self.order), samples * channels)
            image = (self.weights @ columns).mT.reshape(samples, channels, self.grid.height, self.grid.width)
        return image if batched else image[0]

"""A static receiver at inference: compositing weights
as one sparse matrix applied to the features.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.ops import backends
from gsparc.ops.geometry import SphereGrid
from gsparc.ops.transforms import needs_reference


class StalePlan(RuntimeError):
    """The field has changed since its view was frozen."""


@dataclass(frozen=True)
class FrozenPlan:
    """Compositing weights of one pose, pixels by Gaussians.

    Attributes:
        grid: directions of the pixels.
        backend: name of the backend that made it and renders it.
        version: the field's own counter at the time of freezing.
        order: (V,) rows of the features, the Gaussians that this receiver sees.
        buffers: the backend's sparse weights, alpha times transmittance.
    """

    grid: SphereGrid
    backend: str
    version: int
    order: Tensor
    buffers: tuple[Tensor, ...]

    @torch.no_grad()
    def render(self, features: Tensor, version: int) -> Tensor:
        """Return the image (C, H, W) of features (N, C), or (B, C, H, W) of (B, N, C);
        not differentiable.

        Raises:
            StalePlan: if `version`, the field's counter now, is not the one this view was made
                from.
            RuntimeError: under `torch.func` and in forward mode, where a constant would be no
                answer.
            ValueError, TypeError: features of another number, dtype or device, or (on the CPU) not
                finite.
        """
        # The field's own counter: that of a tensor misses writes through `.data`.
        if version != self.version:
            raise StalePlan(
                f"this view was frozen at version {self.version}, the field is at {version}: "
                "freeze again"
            )
        return self._render(features, visible_only=False)

    @torch.no_grad()
    def render_visible(self, seen: Tensor) -> Tensor:
        """Render as `render` does, features (V, C) or (B, V, C)
        of the Gaussians in `order` alone.
        """
        if seen.dim() not in (2, 3) or seen.shape[-2] != len(self.order):
            count = len(self.order)
            raise ValueError(
                f"features must be ({count}, C) or (B, {count}, C) of those seen, got "
                f"{tuple(seen.shape)}"
            )
        return self._render(seen, visible_only=True)

    def _render(self, features: Tensor, *, visible_only: bool) -> Tensor:
        if needs_reference(features):
            raise RuntimeError(
                "a frozen view has no derivatives and cannot be mapped: composite the plan it "
                "was made from"
            )
        # The weights are the last of every backend's buffers.
        if features.dtype != self.buffers[-1].dtype:
            raise TypeError(
                f"features are {features.dtype}, this view was frozen in {self.buffers[-1].dtype}"
            )
        if features.device != self.order.device:
            raise ValueError(
                f"features are on {features.device} but this view on {self.order.device}; move one"
            )
        if features.dim() not in (2, 3):
            raise ValueError(f"features must be (N, C) or (B, N, C), got {tuple(features.shape)}")
        batch = features if features.dim() == 3 else features.unsqueeze(0)
        image = backends.backend_named(self.backend).render_frozen(
            self.grid, self.buffers, batch, self.order, visible_only
        )
        # The first and last of (B, N, C): B and C.
        return image.unflatten(0, batch.shape[::2]) if features.dim() == 3 else image

"""Centres of Gaussians are held near the scene (the authors' program)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import lightning.pytorch as L
import torch

from gsparc.base.limits import Checked, number, setting


@dataclass(eq=False)
class Bounds(Checked, L.Callback):
    """After each step, moves centres that left the scene box enlarged
    by `margin` back to its faces.

    >>> Bounds(margin=4.0).margin
    4.0

    Args:
        margin: enlargement of the box on each side [m].
    """

    edits_gaussians: ClassVar = True
    margin: float = setting(4.0, number(0))

    @torch.no_grad()
    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Clamp."""
        field = module.model.gaussians
        low, high = (torch.as_tensor(side).to(field.means) for side in module.model.site.box)
        field.means.clamp_(low - self.margin, high + self.margin)
        # Views frozen before are refused from now on.
        field.version += 1

"""Periodic opacity reset, which clears floaters (paper, algorithm 1)."""

from __future__ import annotations

import math
from typing import Any

import lightning.pytorch as L
import torch

from gsparc.data.limits import SHARE, check_arguments, whole


class OpacityReset(L.Callback):
    """sigma_i <- min(sigma_i, ceiling) every `interval` steps until `stop`; Adam's moments follow.

    Args:
        interval: steps between resets.
        stop: last step at which one may happen.
        ceiling: opacity after the reset.
    """

    def __init__(self, interval: int = 3000, stop: int = 15_000, ceiling: float = 0.01) -> None:
        check_arguments(locals(), interval=whole(1), stop=whole(0), ceiling=SHARE)
        self.interval = interval
        self.stop = stop
        self.ceiling = math.log(ceiling / (1 - ceiling))

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Reset when the schedule says so."""
        step = trainer.global_step
        if step == 0 or step > self.stop or step % self.interval:
            return
        field = module.model.gaussians
        with torch.no_grad():
            lowered = field.opacity_logits > self.ceiling
            field.opacity_logits.clamp_(max=self.ceiling)
            state = trainer.optimizers[0].state.get(field.opacity_logits, {})
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key][lowered] = 0
            field.version += 1

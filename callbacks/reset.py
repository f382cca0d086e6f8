"""Periodic opacity reset, which clears floaters (paper, algorithm 1)."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Any

import lightning.pytorch as L
import torch

from gsparc.data.limits import SHARE, Checked, setting, whole

log = logging.getLogger(__name__)


@dataclass(eq=False)
class OpacityReset(Checked, L.Callback):
    """sigma_i <- min(sigma_i, ceiling) every `interval` steps until `stop`; Adam's moments follow.

    Validation falls by several decibels and takes about an interval to recover: where fewer steps are left,
    there is no reset.

    Args:
        interval: steps between resets.
        stop: last step at which one may happen.
        ceiling: opacity after the reset.
    """

    interval: int = setting(3000, whole(1))
    stop: int = setting(15_000, whole(0))
    ceiling: float = setting(0.01, SHARE)

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Reset when the schedule says so."""
        step = trainer.global_step
        if module.conditional or step == 0 or step > self.stop or step % self.interval:
            return
        if step + self.interval > module.total_steps:
            left = module.total_steps - step
            log.info("no opacity reset at step %d: %d steps are too few to recover in", step, left)
            return
        field, ceiling = module.model.gaussians, math.log(self.ceiling / (1 - self.ceiling))
        with torch.no_grad():
            lowered = field.opacity_logits > ceiling
            field.opacity_logits.clamp_(max=ceiling)
            state = trainer.optimizers[0].state.get(field.opacity_logits, {})
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key][lowered] = 0
            field.version += 1

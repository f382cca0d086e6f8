"""Periodic opacity reset, which clears floaters (paper, algorithm 1)."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import lightning.pytorch as L
import torch

from gsparc.base.limits import SHARE, Checked, setting, whole
from gsparc.field.schedule import INTERVAL, STEPS, acts_at_step, to_steps
from gsparc.training.tracking import log_event

log = logging.getLogger(__name__)


@dataclass(eq=False)
class OpacityReset(Checked, L.Callback):
    """sigma_i <- min(sigma_i, ceiling) every `interval` steps until `stop`; Adam's moments follow.

    Validation falls by several decibels and takes about an interval to recover: where fewer steps
    are left, there is no reset, nor in a training of fewer than `least_steps`, nor after a start in
    closed form, whose emissions were solved for the opacities as they are.

    >>> OpacityReset(ceiling=1.5)
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: ceiling=1.5: a number above 0 and below 1 is needed

    Args:
        interval: steps between resets; below 1 a share of all steps.
        stop: last step at which one may happen, or its share.
        ceiling: opacity after the reset.
        least_steps: of a training that has resets: of 400 steps one costs 14 dB and half the steps.
    """

    edits_gaussians: ClassVar = True
    interval: int | float = setting(3000, INTERVAL)
    stop: int | float = setting(15_000, STEPS)
    ceiling: float = setting(0.01, SHARE)
    least_steps: int = setting(2000, whole(0))

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """Say why there will be none, where there will be none."""
        if module.solved:
            log.info("no opacity reset: emissions were solved for the opacities as they are")
        elif module.total_steps < self.least_steps:
            log.info("no opacity reset in fewer than %d steps (least_steps)", self.least_steps)

    def on_train_batch_start(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Reset when the schedule says so, after the validation of the step before."""
        step = module.global_step
        if module.solved or module.total_steps < self.least_steps:
            return
        interval = to_steps(self.interval, module.total_steps)
        if not acts_at_step(step, 1, self.stop, self.interval, module.total_steps):
            return
        if step + interval > module.total_steps:
            rest = module.total_steps - step
            log.info("no opacity reset at step %d: %d steps are too few to recover in", step, rest)
            return
        # The logit of the ceiling: opacities are stored as logits.
        field, ceiling = module.model.gaussians, math.log(self.ceiling / (1 - self.ceiling))
        with torch.no_grad():
            lowered = field.opacity_logits > ceiling
            field.opacity_logits.clamp_(max=ceiling)
            state = trainer.optimizers[0].state.get(field.opacity_logits, {})
            # Adam's moments are of the opacities before: kept, they would carry the old step on.
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key][lowered] = 0
            # Views frozen before are refused from now on.
            field.version += 1
        count = int(lowered.sum())
        log.info("step %d: opacities of %d Gaussians lowered to %g", step, count, self.ceiling)
        log_event(trainer, module, {"reset/lowered": count})

"""The state of a training as `last.ckpt`, to go on from after an interruption."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import lightning.pytorch as L

from gsparc.base.limits import Checked, setting
from gsparc.field.gradient_stage import step_is_complete
from gsparc.field.schedule import INTERVAL, to_steps


@dataclass(eq=False)
class Checkpoint(Checked, L.callbacks.Checkpoint):  # Lightning calls it after all other callbacks
    """Write the state every `interval` steps, or share of all steps;
    after the last step it always is.

    >>> Checkpoint(interval=500).interval  # steps; 0.25 is a quarter of them
    500

    Args:
        interval: steps between two; below 1 a share of all steps.
    """

    interval: int | float = setting(0.25, INTERVAL)

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Write when the schedule says so."""
        step = module.global_step
        # After the last step the state is written in any case, and not here.
        due = (
            step
            and step % to_steps(self.interval, module.total_steps) == 0
            and step < module.total_steps
        )
        if due and step_is_complete(trainer):
            trainer.save_checkpoint(module.run_dir / "last.ckpt")

    on_validation_end = on_train_batch_end  # type: ignore[assignment]

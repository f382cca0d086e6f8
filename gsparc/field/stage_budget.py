"""What the steps of a stage spend, and the seconds that end them before their schedule does."""

from __future__ import annotations

import os
from dataclasses import astuple
from typing import Any

import lightning.pytorch as L
import torch

from gsparc.field.distributed import first_process_value
from gsparc.training.time_budget import NOTHING, Spent, TimeBudget

SPENT = "time/spent_s"  # metric of both clocks


class StageBudget(L.Callback):
    """Counts the seconds of a stage, validations too, and ends it when they are over.

    Args:
        budget: running, with all that was spent before.
    """

    def __init__(self, budget: TimeBudget) -> None:
        self.budget, self._begin, self._process = budget, budget.by_clock, os.getpid()
        self._resumed = NOTHING

    @property
    def _spent_learning(self) -> Spent:
        return self.budget.by_clock - self._begin

    def _stop_if_spent(self, trainer: L.Trainer) -> None:
        if first_process_value(float(self.budget.is_spent()), trainer):
            trainer.should_stop = True

    def setup(self, trainer: L.Trainer, module: Any, stage: str) -> None:
        """Count in another process, whose processor time is its own."""
        if os.getpid() != self._process:
            self.budget.restart_processor()

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """Leave out what making the Trainer took, which is no part of the stage; look at the clock."""
        self._begin = self._begin + (self._spent_learning - self._resumed)
        self._stop_if_spent(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """End when the seconds are over."""
        self._stop_if_spent(trainer)

    def on_fit_end(self, trainer: L.Trainer, module: Any) -> None:
        """Bring home what was spent; only metrics leave the process where there are several devices."""
        trainer.callback_metrics[SPENT] = torch.tensor(astuple(self.budget.by_clock), dtype=torch.float64)

    def state_dict(self) -> dict[str, Any]:
        """Return the seconds spent, so that a resumed run has only the rest."""
        return {"seconds": self._spent_learning.wall, "processor_s": self._spent_learning.processor}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self._resumed = Spent(float(state["seconds"]), float(state["processor_s"]))
        self.budget.charge(self._resumed)

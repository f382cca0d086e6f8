"""Training for a number of seconds: every schedule written in steps is stretched to end with the budget.

Nothing is known of a step's cost before: after each step the share of the budget that is spent says where in
its schedule the training is.
"""

from __future__ import annotations

import os
from dataclasses import astuple
from typing import Any

import lightning.pytorch as L
import torch

from gsparc.training.processes import agreed
from gsparc.training.time_budget import NOTHING, Spent, TimeBudget

SPENT = "time/spent_s"  # metric of both clocks


class Pace:
    """How far a schedule written for `total` steps has come, when seconds decide.

    Args:
        total: steps of the schedule.
        budget_s: seconds in which they are to pass [s].
    """

    def __init__(self, total: int, budget_s: float) -> None:
        self.total, self.budget_s = total, budget_s
        self.step = self._before = 0

    def spend(self, seconds: float) -> None:
        """Now this much is spent [s]."""
        self._before = self.step
        share = seconds / self.budget_s if self.budget_s > 0 else 1.0
        self.step = min(int(share * self.total), self.total)

    def passed(self, interval: int) -> int | None:
        """The last multiple of `interval` that the last step passed or reached; None when it passed none."""
        multiple = self.step // interval * interval
        return multiple if multiple > self._before else None

    @property
    def over(self) -> bool:
        """Whether the budget is spent."""
        return self.step >= self.total


class Budget(L.Callback):
    """Counts the seconds of a stage, validations too, and ends it with its pace.

    Args:
        pace: told after every step; None where steps decide, and the budget only ends them.
        budget: running, with all that was spent before.
    """

    def __init__(self, pace: Pace | None, budget: TimeBudget) -> None:
        self.pace, self.budget, self._begin, self._process = pace, budget, budget.counted, os.getpid()
        self._validating = 0.0  # seconds of the longest validation: one more follows the last step
        self._since, self._resumed = 0.0, NOTHING

    @property
    def _learned(self) -> Spent:
        return self.budget.counted - self._begin

    def _look(self, trainer: L.Trainer) -> None:
        if self.pace is not None:
            self.pace.spend(agreed(self._learned.by(self.budget.clock) + self._validating, trainer))
            trainer.should_stop = trainer.should_stop or self.pace.over
        elif agreed(float(self.budget.over()), trainer):
            trainer.should_stop = True

    def setup(self, trainer: L.Trainer, module: Any, stage: str) -> None:
        """Of several processes each has a processor time of its own."""
        if os.getpid() != self._process:
            self.budget.moved()

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """The schedule begins now; what making the Trainer took is no part of it, and shortens it."""
        setup = self._learned - self._resumed
        self._begin = self._begin + setup
        if self.pace is not None:
            self.pace.budget_s -= agreed(setup.by(self.budget.clock), trainer)
        self._look(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Say how far it is; end when it is over."""
        self._look(trainer)

    def on_validation_start(self, trainer: L.Trainer, module: Any) -> None:
        """Look at the clock."""
        self._since = self.budget.spent

    def on_validation_end(self, trainer: L.Trainer, module: Any) -> None:
        """How long it took."""
        self._validating = max(self._validating, self.budget.spent - self._since)

    def on_fit_end(self, trainer: L.Trainer, module: Any) -> None:
        """Bring home what was spent; only metrics leave the process where there are several devices."""
        trainer.callback_metrics[SPENT] = torch.tensor(astuple(self.budget.counted), dtype=torch.float64)

    def state_dict(self) -> dict[str, Any]:
        """Seconds spent, so that a resumed run has only the rest."""
        return {"seconds": self._learned.wall, "processor_s": self._learned.processor}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self._resumed = Spent(float(state["seconds"]), float(state["processor_s"]))
        self.budget.charge(self._resumed)

"""Gradient steps that pay: parameters of the best validation are kept, and steps end when none is better."""

from __future__ import annotations

import copy
import logging
from typing import Any

import lightning.pytorch as L
import torch

from gsparc.field import edit
from gsparc.training.fit import KEPT
from gsparc.training.module import GaussianModule
from gsparc.training.processes import agreed

log = logging.getLogger(__name__)

PATIENCE = 0.25  # of the schedule without a better validation: an opacity reset takes some of it to recover
SHORT = 0.1  # the same after a closed-form start, and the share between validations
LEAST_GAIN = 1e-3  # of the error, for a validation to count as better


class KeepBest(L.Callback):
    """Looks before the first step and at every validation; restores the best when training ends.

    Args:
        patience: share of the schedule without a better validation that ends training.

    Attributes:
        position: of the kept parameters in the schedule [steps]; 0: as they were before the first.
        step: the number of steps taken until then.
    """

    def __init__(self, patience: float = PATIENCE) -> None:
        self.patience, self.error = patience, float("inf")
        self.step = self.position = 0
        self._kept: dict[str, Any] | None = None
        self._looked_at = -1  # step

    def on_train_start(self, trainer: L.Trainer, module: GaussianModule) -> None:  # type: ignore[override]
        """What the initialiser has reached."""
        if self._kept is None:
            self._measure(trainer, module)
            if self._kept is not None:
                for logger in trainer.loggers:  # where the learning curve begins
                    logger.log_metrics({"val/error": self.error}, step=0)

    def _measure(self, trainer: L.Trainer, module: GaussianModule) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        if len(data.fold.val):
            with torch.no_grad():
                parts = [(len(b), module.error(b.to(module.device)).mean()) for b in data.val_dataloader()]
            error = sum(n * float(e) for n, e in parts) / sum(n for n, _ in parts)
            self._look(module, agreed(error, trainer), trainer.global_step)

    def on_validation_end(self, trainer: L.Trainer, module: GaussianModule) -> None:  # type: ignore[override]
        """Keep what is better; end training when nothing was for long."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        error = agreed(float(trainer.callback_metrics["val/error"]), trainer)
        self._look(module, error, trainer.global_step)
        if module.position - self.position >= self.patience * module.total_steps:
            trainer.should_stop = True

    def _look(self, module: GaussianModule, error: float, step: int) -> None:
        self._looked_at = step
        if error < (1 - LEAST_GAIN) * self.error:
            self.error, self.step, self.position = error, step, module.position
            self._kept = copy.deepcopy(module.model.state_dict())

    def on_fit_end(self, trainer: L.Trainer, module: GaussianModule) -> None:  # type: ignore[override]
        """Back to the best; also after a checkpoint with every step done."""
        if self._looked_at != trainer.global_step:  # a checkpoint is written before its step's validation
            self._measure(trainer, module)
        if self._kept is None:
            return
        for name, value in zip(KEPT, (self.step, self.position), strict=True):  # also from another process
            trainer.callback_metrics[name] = torch.tensor(value, dtype=torch.float64)
        if self.step == trainer.global_step:
            return
        model = module.model
        edit.resize(model, model.gaussians, len(self._kept["gaussians.ids"]))
        model.load_state_dict(self._kept)
        steps = trainer.global_step
        log.info(
            "gradient steps: %d taken, %s kept: what came after was no better on validation rows",
            steps, f"the first {self.step}" if self.step else "none",
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """What is kept, so that a resumed run ends with it, too."""
        return {"error": self.error, "step": self.step, "position": self.position, "kept": self._kept}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on."""
        self.error, self.step, self.position = state["error"], state["step"], state["position"]
        self._kept = state["kept"]


class StopAt(L.Callback):
    """Ends training where an earlier stage found that further steps do not pay.

    Args:
        position: in the schedule [steps].
    """

    def __init__(self, position: int) -> None:
        self.position = position

    def on_train_batch_end(self, trainer: L.Trainer, module: GaussianModule, *unused: Any) -> None:  # type: ignore[override]
        """After every step."""
        trainer.should_stop = trainer.should_stop or module.position >= self.position

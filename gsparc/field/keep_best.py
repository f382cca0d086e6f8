"""Steps that pay: of all looks at validation rows, from before the first step on,
the best is kept.
"""

from __future__ import annotations

import copy
import logging
from typing import Any

import lightning.pytorch as L
import torch
from torch import Tensor

from gsparc.field import edit
from gsparc.field.distributed import first_process_value
from gsparc.field.gradient_stage import KEPT
from gsparc.field.module import GaussianModule
from gsparc.processes.uncertainty import is_surely_above

log = logging.getLogger(__name__)

SURE = 2.0  # standard errors of paired rows by which a look must be better than the start
# Looks without one that is, after which steps that nobody asked for end. Of 15 fits (spectra of
# rfid by two ways and splits, simulated spectra, moving receivers, channels, powers)
# what gained did so by the second.
PATIENCE = 3


class KeepBest(L.Callback):
    """Restores the parameters of the best look when training ends.

    A look is kept where the error of its rows is below that of the same rows before the first step
    by two standard errors, and below that of all looks before it.

    Args:
        patience: looks after which training ends where none of them is kept; None: it goes on to
            its end.

    Attributes:
        step: of the kept parameters; 0: as they were before the first.
    """

    def __init__(self, patience: int | None = None) -> None:
        self.patience = patience
        self.error = float("inf")
        self.step = self.looks = 0
        self.start = torch.zeros(0)  # errors of the rows before the first step (n,)
        self._kept: dict[str, Any] | None = None

    def on_validation_end(self, trainer: L.Trainer, module: GaussianModule) -> None:  # type: ignore[override]
        """Keep what is better; the look before the first step is Lightning's sanity check."""
        if trainer.state.fn != "fit" or not len(module.held_out):
            return
        error = first_process_value(float(module.held_out.mean()), trainer)
        if trainer.sanity_checking:
            self.start = module.held_out
        surely = first_process_value(float(_is_surely_less(module.held_out, self.start)), trainer)
        if trainer.sanity_checking or (error < self.error and surely):
            self.error, self.step = error, trainer.global_step
            self._kept = copy.deepcopy(module.model.state_dict())
        self.looks += not trainer.sanity_checking
        if self.looks == self.patience and not self.step:
            trainer.should_stop = True
            log.info("gradient steps end: no significant gain in %d validations", self.looks)

    def on_fit_end(self, trainer: L.Trainer, module: GaussianModule) -> None:  # type: ignore[override]
        """Go back to the best; also after a checkpoint with every step done."""
        if self._kept is None:
            return
        # Leaves a process
        trainer.callback_metrics[KEPT] = torch.tensor(self.step, dtype=torch.float64)
        steps = trainer.global_step
        if module.solved and len(self.start) and self.step:
            log.info(
                "%d gradient steps changed the squared error of %d validation rows from %.4g to "
                "%.4g; "
                "a random start (experiment=field) depends more on the loss and on callbacks",
                self.step,
                len(self.start),
                float(self.start.mean()),
                self.error,
            )
        if self.step == steps:
            return
        model = module.model
        edit.resize_gaussians(model, model.gaussians, len(self._kept["gaussians.ids"]))
        model.load_state_dict(self._kept)
        log.info(
            "gradient steps: %d taken, %s kept: more are not significantly better on %d "
            "validation rows",
            steps,
            f"the first {self.step}" if self.step else "none",
            len(self.start),
        )

    def state_dict(self) -> dict[str, Any]:
        """Return what is kept, so that a resumed run ends with it, too."""
        counts = {"step": self.step, "looks": self.looks}
        return {"error": self.error, **counts, "start": self.start, "kept": self._kept}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on."""
        self.error, self.step, self.looks = state["error"], state["step"], state["looks"]
        self.start, self._kept = state["start"], state["kept"]


def _is_surely_less(errors: Tensor, start: Tensor) -> bool:
    """Whether errors (n,) are below those of the start (n,)
    by `SURE` standard errors of the differences.
    """
    # A training without a look before its first step keeps the least.
    return len(errors) != len(start) or is_surely_above((start - errors).cpu().numpy(), SURE)


class StopAt(L.Callback):
    """Ends training where an earlier stage found that further steps do not pay.

    Args:
        step: the last one.
    """

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: L.Trainer, module: GaussianModule, *unused: Any) -> None:  # type: ignore[override]
        """End training after the last step, when it was taken."""
        trainer.should_stop = trainer.should_stop or trainer.global_step >= self.step

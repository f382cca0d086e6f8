"""Predicted against true spectra of validation rows, drawn every few steps of training."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch

from gsparc.base.limits import Checked, setting, whole
from gsparc.callbacks.ledger import CostLedger
from gsparc.evaluation.examples import Examples
from gsparc.field.schedule import INTERVAL, to_steps
from gsparc.pictures.drawing import save
from gsparc.pictures.pictures import draw_spectra
from gsparc.processes.few_rows import evenly_spaced
from gsparc.training.tracking import log_picture


@dataclass(eq=False)
class Pictures(Checked, L.Callback):
    """Draw a few validation rows; without any, nothing, because training rows flatter.

    >>> Pictures(count=0)
    Traceback (most recent call last):
        ...
    gsparc.base.limits.SettingError: count=0: a whole number of at least 1 is needed

    Args:
        every: steps between pictures, or a share of all; the last step is always drawn.
        count: number of rows drawn.
    """

    every: int | float = setting(0.5, INTERVAL)
    count: int = setting(4, whole(1))

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Draw when it is time."""
        step = trainer.global_step
        if not trainer.is_global_zero or not module.site.target.is_image:
            return
        if step % to_steps(self.every, module.total_steps) and step != trainer.max_steps:
            return
        data = trainer.datamodule  # type: ignore[attr-defined]
        candidates = data.fold.val
        if not len(candidates):
            return
        # The same rows at every step, so that pictures can be compared.
        rows = candidates[evenly_spaced(len(candidates), self.count)]
        callbacks = trainer.callbacks  # type: ignore[attr-defined]
        ledger = next((part for part in callbacks if isinstance(part, CostLedger)), None)
        with nullcontext() if ledger is None else ledger.paused(), torch.no_grad():
            batch = data.measurements.batch(rows).to(module.device)
            predicted = module.mean(batch)
            title = f"validation, step {step}"
            title += "" if ledger is None else f", {ledger.elapsed():.0f} s of training"
            path = module.run_dir / "pictures" / f"step_{step:06d}.png"
            true, predictions = batch.target.cpu().numpy(), {"predicted": predicted.cpu().numpy()}
            unknown = np.full(len(rows), np.nan)
            examples = Examples(
                rows, np.array(module.site.grid.edges()), true, unknown, predictions
            )
            save(draw_spectra(examples, title), path, 100)
            log_picture(trainer.loggers, "predictions", path, step)

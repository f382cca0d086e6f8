"""A progress bar over optimiser steps: time left, loss and metrics, number of Gaussians."""

from __future__ import annotations

import time
from typing import Any

import lightning.pytorch as L
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

SHOWN = {  # all of it fits a terminal of 80 columns
    "train/task_loss": "loss {:.4g}",
    "val/ssim_gauss": "ssim {:.4f}",
    "val/psnr_db": "{:.2f} dB",
    "val/mse": "mse {:.4g}",
}


TIMED = 50  # steps, after the first, from which the minutes of the training are estimated
LONG_S = 60.0  # trainings beyond are worth a line
CHANGED = 1.3  # ratio of two estimates that is worth another line


class StepProgress(L.Callback):
    """A rich progress bar over optimiser steps (epochs mean little when data are few).

    A line says after some steps how long all take here, where that is over a minute, and again at
    quarters of the way where they have become slower or faster.
    """

    def __init__(self) -> None:
        self._bar: Progress | None = None
        self._began: tuple[int, float] | None = None  # a step, and when it was done [s]
        self._told_s: float | None = None  # what a step takes, as the last line said

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """Draw the bar, once for all devices."""
        if not trainer.is_global_zero:
            return
        self._bar = Progress(
            TextColumn("{task.description}{task.completed:.0f}/{task.total:.0f}"),
            BarColumn(bar_width=8),
            TimeRemainingColumn(elapsed_when_finished=True),
            TextColumn("{task.fields[figures]}"),
        )
        self._bar.start()
        self._began = self._told_s = None
        stage = "again, on all rows " if module.run_dir.name == "refit" else ""
        self._bar.add_task(
            stage, total=trainer.max_steps, completed=trainer.global_step, figures=""
        )

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Advance; metrics are read every 20 steps: reading waits for the device."""
        if self._bar is None:
            return
        task = self._bar.task_ids[0]
        step = trainer.global_step
        self._bar.update(task, completed=step)
        self._began = self._began or (step, time.perf_counter())
        since, quarter = step - self._began[0], max(trainer.max_steps // 4, 1)
        if since == TIMED or (since > TIMED and step % quarter == 0):
            now = time.perf_counter()
            each, self._began = (now - self._began[1]) / since, (step, now)
            other = self._told_s is None or not 1 / CHANGED < each / self._told_s < CHANGED
            if other and (rest_s := each * (trainer.max_steps - step)) > LONG_S:
                self._told_s = each
                pace = f"{trainer.max_steps:,} steps, {1000 * each:.0f} ms each here"
                self._bar.console.print(
                    f"{pace}: about {rest_s / 60:.0f} min to go", highlight=False
                )
        if step % 20 == 0 or step == trainer.max_steps:
            result = {form: trainer.callback_metrics.get(key) for key, form in SHOWN.items()}
            figures = [
                form.format(float(value)) for form, value in result.items() if value is not None
            ]
            figures += [] if module.count is None else [f"{module.count} Gaussians"]
            self._bar.update(task, figures=", ".join(figures))

    def on_train_end(self, *args: Any, **kwargs: Any) -> None:
        """Leave the bar as it is on the screen; also after an error."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    on_exception = on_train_end

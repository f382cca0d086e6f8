"""What training cost: seconds without validation and pictures, beside every accuracy logged."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as L

from gsparc.training import curve


class CostLedger(L.Callback):
    """A stopwatch that runs only while the model learns, and the learning curve against it.

    `learning_curve.csv` in the run directory has a row per validation,
    the first before the first step.

    >>> ledger = CostLedger()
    >>> with ledger.paused():  # for work that is not training
    ...     ledger.elapsed()
    0.0
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._rows: list[dict[str, Any]] = []
        self._running_since: float | None = None

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the watch for work that is not training."""
        # A pause within a pause must not start the watch when it ends.
        was_running = self._running_since is not None
        self._stop_clock()
        try:
            yield
        finally:
            if was_running:
                self._start_clock()

    def _start_clock(self) -> None:
        self._running_since = time.perf_counter()

    def _stop_clock(self) -> None:
        self.seconds = self.elapsed()
        self._running_since = None

    def elapsed(self) -> float:
        """Return the training time so far [s]."""
        running = 0.0 if self._running_since is None else time.perf_counter() - self._running_since
        return self.seconds + running

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """Start the watch; the curve of an interrupted run ends with the checkpoint
        that it goes on from.
        """
        if trainer.is_global_zero and trainer.global_step:
            # Rows after the checkpoint are of steps that are taken again.
            self._rows = [row for row in self._rows if int(row["step"]) <= trainer.global_step]
            curve.write_curve(module.run_dir, self._rows)
        self._start_clock()

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        """Stop the watch; also for a validation, which does not count as training time."""
        self._stop_clock()
        module.train_seconds = self.seconds

    on_validation_start = on_train_end  # type: ignore[assignment]
    on_fit_end = on_train_end  # type: ignore[assignment]  # alone, after a checkpoint with every step done

    def on_exception(self, trainer: L.Trainer, module: Any, exception: BaseException) -> None:
        """Stop the watch."""
        self._stop_clock()

    def on_validation_end(self, trainer: L.Trainer, module: Any) -> None:
        """Write a row of the learning curve and go on."""
        # `trainer.validate` by itself is no training:
        # neither a row of the curve nor a running watch.
        fitting = trainer.state.fn == "fit"
        if trainer.is_global_zero and fitting and module.figures:
            self._log_seconds(trainer, module)
        # Lightning's check of validation comes before the first step: nothing is learned yet.
        if fitting and not trainer.sanity_checking:
            self._start_clock()

    def _log_seconds(self, trainer: L.Trainer, module: Any) -> None:
        step, loss = trainer.global_step, trainer.callback_metrics.get("train/task_loss")
        figures = {name: value for name, value in module.figures.items() if name in curve.FIGURES}
        # What was solved before the first step is part of what an accuracy costs.
        row = curve.curve_row(
            module.prepared_seconds + self.seconds,
            f"step {step}" if step else module.start,
            module.figures["val/error"],
            step,
            num_gaussians=module.count,
            **figures,
            **({} if loss is None else {"train/task_loss": float(loss)}),
        )
        self._rows.append(row)
        curve.write_curve(module.run_dir, self._rows)
        curve.log_row(trainer.loggers, row)

    def state_dict(self) -> dict[str, Any]:
        """Return the time and the curve so far, so that a resumed run goes on with both."""
        return {"seconds": self.elapsed(), "rows": list(self._rows)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on counting."""
        self.seconds, self._rows = float(state["seconds"]), list(state["rows"])

"""What training cost: seconds without validation and pictures, beside every accuracy logged."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import lightning.pytorch as L

COLUMNS = ("step", "train_s", "num_gaussians", "train/task_loss", "val/ssim_gauss", "val/psnr_db", "val/mse")


class CostLedger(L.Callback):
    """A stopwatch that runs only while the model learns, and the learning curve against it.

    Args:
        file: name of the curve's CSV file in the run directory; a row per validation.
    """

    def __init__(self, file: str = "learning_curve.csv") -> None:
        self.file = file
        self.seconds = 0.0
        self._running_since: float | None = None

    @staticmethod
    def paused_in(trainer: L.Trainer) -> AbstractContextManager[None]:
        """Pause the trainer's ledger, if it has one, for work that is not training."""
        ledgers = [c for c in trainer.callbacks if isinstance(c, CostLedger)]  # type: ignore[attr-defined]
        return ledgers[0].paused() if ledgers else nullcontext()

    @staticmethod
    def seconds_in(trainer: L.Trainer) -> float | None:
        """Seconds on the trainer's ledger [s]; None when it keeps none."""
        ledgers = [c for c in trainer.callbacks if isinstance(c, CostLedger)]  # type: ignore[attr-defined]
        return ledgers[0].elapsed() if ledgers else None

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the watch for work that is not training."""
        was_running = self._running_since is not None
        self._stop()
        try:
            yield
        finally:
            if was_running:
                self._start()

    def _start(self) -> None:
        self._running_since = time.perf_counter()

    def _stop(self) -> None:
        self.seconds = self.elapsed()
        self._running_since = None

    def elapsed(self) -> float:
        """Training time so far [s]."""
        running = 0.0 if self._running_since is None else time.perf_counter() - self._running_since
        return self.seconds + running

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """Start the watch."""
        self._start()

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        """Stop the watch; also for a validation, which does not count as training time."""
        self._stop()
        module.train_seconds = self.seconds

    on_validation_start = on_train_end  # type: ignore[assignment]
    on_fit_end = on_train_end  # type: ignore[assignment]  # alone, after a checkpoint with every step done

    def on_exception(self, trainer: L.Trainer, module: Any, exception: BaseException) -> None:
        """Stop the watch."""
        self._stop()

    def on_validation_end(self, trainer: L.Trainer, module: Any) -> None:
        """Write a row of the learning curve and go on."""
        if trainer.sanity_checking:
            return
        if trainer.is_global_zero:
            self._note(trainer, module)
        if trainer.state.fn == "fit":
            self._start()

    def _note(self, trainer: L.Trainer, module: Any) -> None:
        figures = {key: float(value) for key, value in trainer.callback_metrics.items()}
        row = {key: figures.get(key, "") for key in COLUMNS}
        row |= {
            "step": trainer.global_step,
            "train_s": round(module.prepared_seconds + self.seconds, 3),
            "num_gaussians": int(figures.get("model/num_gaussians", 0)),
        }
        self._append(module.run_dir / self.file, row)

    @staticmethod
    def _append(path: Path, row: dict[str, Any]) -> None:
        fresh = not path.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if fresh:
                writer.writeheader()
            writer.writerow(row)

    def state_dict(self) -> dict[str, Any]:
        """The time so far, so that a resumed run keeps counting."""
        return {"seconds": self.elapsed()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on counting."""
        self.seconds = float(state["seconds"])

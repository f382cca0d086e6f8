"""One stage of gradient training under Lightning."""

from __future__ import annotations

import logging
import math
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.plugins.io import CheckpointIO
from torch.multiprocessing.spawn import ProcessException, ProcessExitedException

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.datamodule import DataModule, Loaded
from gsparc.field.distributed import SummedGradients
from gsparc.field.module import NetworkModule
from gsparc.training.context import FitContext
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

SPENT, SPENT_CPU = "time/spent_s", "time/spent_cpu_s"
TAKEN = "steps/taken"
KEPT = "steps/kept"
LOG_EVERY = 10  # steps: Lightning spends a fifth of a step on logging two figures
LOOKS = 10  # validations of a training, where the Trainer is given no interval

# What conf/trainer/cpu.yaml says, for callers from Python.
DEFAULTS = partial(
    L.Trainer,
    accelerator="cpu",
    devices=1,
    strategy="auto",
    precision="32-true",
    enable_progress_bar=False,
    enable_model_summary=False,
)


@dataclass(frozen=True)
class TrainerResult:
    """Steps of a training that has ended.

    Attributes:
        kept: steps whose result is kept; None where the schedule was gone through to its end.
        taken: steps in all.
        notes: that `trainer.max_time` ended it.
    """

    kept: int | None
    taken: int
    notes: tuple[str, ...]


class ReportSteps(L.Callback):
    """Steps and seconds of training as metrics: of all attributes, only these leave a process.

    Args:
        watch: of the fit; a resumed run has the seconds of its stage that were spent before.
    """

    def __init__(self, watch: Stopwatch) -> None:
        self.watch, self._began, self._cpu_began = watch, watch.seconds, watch.cpu_seconds

    def state_dict(self) -> dict[str, Any]:
        """Return the seconds spent."""
        cpu = self.watch.cpu_seconds - self._cpu_began
        return {"seconds": self.watch.seconds - self._began, "cpu_seconds": cpu}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.watch.charge(float(state["seconds"]), float(state.get("cpu_seconds", 0.0)))

    def on_train_start(self, trainer: L.Trainer, module: NetworkModule) -> None:  # type: ignore[override]
        """Say from which step a resumed run goes on."""
        if trainer.global_step and trainer.is_global_zero:
            path, steps = trainer.ckpt_path, (trainer.global_step, module.total_steps)
            log.info("gradient steps: going on after step %d of %d, as %s left them", *steps, path)

    def on_fit_end(self, trainer: L.Trainer, module: NetworkModule) -> None:  # type: ignore[override]
        """Save, also after a checkpoint with every step done.

        Of an unfinished schedule, what was taken is kept.
        """
        trainer.callback_metrics[SPENT] = torch.tensor(self.watch.seconds, dtype=torch.float64)
        trainer.callback_metrics[SPENT_CPU] = torch.tensor(
            self.watch.cpu_seconds, dtype=torch.float64
        )
        trainer.callback_metrics[TAKEN] = torch.tensor(trainer.global_step, dtype=torch.float64)
        if trainer.global_step < module.total_steps:
            trainer.callback_metrics.setdefault(KEPT, trainer.callback_metrics[TAKEN])


def step_is_complete(trainer: L.Trainer) -> bool:
    """Tell whether a step is done with, at the end of its batch or of its look at validation rows.

    Lightning leaves out a look that follows, where a run goes on from a state before it.
    """
    if trainer.validating:
        return trainer.state.fn == "fit"
    interval = trainer.val_check_batch
    due = isinstance(interval, int) and (trainer.fit_loop.total_batch_idx + 1) % interval == 0
    return trainer.training and not (due and trainer.enable_validation)


class _Stopped(BaseException):
    """Ends training from inside; Lightning would turn a KeyboardInterrupt into an exit without a
    word.
    """


class StopBetweenSteps(L.callbacks.Checkpoint):
    """An interrupt waits for the end of the step,
    so that the checkpoint it leaves is a whole state.

    The last step leaves one, too.

    In several processes it does not wait, nor does a second one:
    the checkpoint before is what is left.

    Args:
        file: the checkpoint written when stopped.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.requested = file, False

    def setup(self, trainer: L.Trainer, module: Any, stage: str) -> None:
        """Make every process that trains as quiet as the first."""
        _quieten_lightning()

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Write the checkpoint and end training when asked to."""
        if self.requested and step_is_complete(trainer):
            trainer.save_checkpoint(self.file)
            raise _Stopped

    on_validation_end = on_train_batch_end  # type: ignore[assignment]

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        """Leave the state after the last step."""
        trainer.save_checkpoint(self.file)

    @contextmanager
    def handling_interrupts(self) -> Iterator[None]:
        """Take interrupts while training runs; outside the main thread there are none to take."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def interrupted(signum: int, frame: Any) -> None:
            if self.requested:
                raise KeyboardInterrupt
            self.requested = True

        before = signal.signal(signal.SIGINT, interrupted)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


def make_trainer(
    module: NetworkModule,
    data: Measurements,
    fold: Fold,
    context: FitContext,
    checkpoints: CheckpointIO,
    watch: Stopwatch,
    keeping: Sequence[L.Callback] = (),
) -> tuple[L.Trainer, DataModule]:
    """Return the Trainer that trains `module` on `fold.train`, watching `fold.val`, and its data.

    `with interruptible(trainer, batches): trainer.fit(module, datamodule=batches, ...)` trains it.

    Args:
        module: what is trained.
        data, fold, context: of the fit.
        checkpoints: how `last.ckpt` is written.
        watch: of the fit.
        keeping: callbacks that say which steps are kept.

    Raises:
        ValueError: several devices that do not train one model.
    """
    folder, make, batches = module.run_dir, context.trainer or DEFAULTS, context.datamodule
    if batches is None or batches.measurements is not data:
        batches = Loaded(data, context.batch_size)
    batches.use(fold, context.seed)
    _quieten_lightning()
    stop = StopBetweenSteps(folder / "last.ckpt")
    usable = _drop_unusable(context.callbacks(), len(fold.val), module.count is not None)
    callbacks = [*keeping, *usable]
    for callback in callbacks:
        if isinstance(callback, L.callbacks.ModelCheckpoint) and callback.dirpath is None:
            callback.dirpath = str(folder)
    interval = make.keywords.get("val_check_interval")
    interval_steps = interval if type(interval) is int else max(1, module.total_steps // LOOKS)
    # A validation sees the figures of its own step.
    module.log_every = (
        math.gcd(LOG_EVERY, interval_steps)
        if len(fold.val)
        else max(LOG_EVERY, interval_steps // LOOKS)
    )
    per_epoch = max(1, len(fold.train) // batches.batch_size)
    options: dict[str, Any] = {
        "log_every_n_steps": max(1, min(50, per_epoch) // module.log_every) * module.log_every,
        "check_val_every_n_epoch": None,  # validations are counted in steps
        "val_check_interval": interval_steps if interval is None else interval,
        # All validation rows, before the first step: where the curve begins
        "num_sanity_val_steps": -1,
    }
    if not len(fold.val):
        options |= {
            "val_check_interval": None,
            "check_val_every_n_epoch": 1,
            "limit_val_batches": 0,
        }
    options["max_steps"] = module.total_steps
    options["max_epochs"] = -1
    processes = SummedGradients.from_strategy(make.keywords.get("strategy"))
    if module.count is None:  # networks of published methods make tensors of their own, on the CPU
        if processes is not None or make.keywords.get("accelerator", "cpu") != "cpu":
            log.warning("published methods train in one process on the CPU, whatever trainer= says")
        processes, options = (
            None,
            {**options, "accelerator": "cpu", "devices": 1, "strategy": "auto"},
        )
    if processes is not None:
        options["strategy"] = processes
    trainer = make(
        callbacks=[*callbacks, ReportSteps(watch), stop],
        logger=list(context.loggers) or False,
        plugins=[checkpoints],
        default_root_dir=folder,
        **options,
    )
    if trainer.world_size > 1 and processes is None:
        raise ValueError(
            "trainer.strategy: several devices need ddp, ddp_spawn or ddp_fork; say trainer=ddp"
        )
    return trainer, batches


@contextmanager
def interruptible(trainer: L.Trainer, batches: DataModule) -> Iterator[None]:
    """Let an interrupt of `trainer.fit` wait for a checkpoint, and say from what to go on.

    Raises:
        KeyboardInterrupt: stopped by the user; the message names the checkpoint to go on from.
        RuntimeError: one of several processes was lost.
    """
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    stop = next(callback for callback in callbacks if isinstance(callback, StopBetweenSteps))
    try:
        with stop.handling_interrupts():
            yield
    except (_Stopped, SystemExit, ProcessException) as ended:
        # Lightning's answer to a KeyboardInterrupt is SystemExit.
        advice = (
            f"go on with ckpt_path={stop.file}"
            if stop.file.exists()
            else ("there is no checkpoint yet")
        )
        if isinstance(ended, ProcessException) and not stop.requested:
            raise RuntimeError(_describe_lost_process(ended, advice)) from ended
        raise KeyboardInterrupt(f"training was interrupted; {advice}") from None
    finally:
        batches.trainer = None  # which holds the optimizer's state


def read_trainer_result(trainer: L.Trainer, watch: Stopwatch) -> TrainerResult:
    """Return the steps of a Trainer that has ended,
    and charge what other processes say of an earlier run.
    """
    metrics = trainer.callback_metrics
    more = float(metrics[SPENT]) - watch.seconds, float(metrics[SPENT_CPU]) - watch.cpu_seconds
    watch.charge(*(max(spent, 0.0) for spent in more))
    best_step = int(metrics[KEPT]) if KEPT in metrics else None
    steps = int(metrics[TAKEN])
    timers = [c for c in trainer.callbacks if isinstance(c, L.callbacks.Timer)]  # type: ignore[attr-defined]
    if steps >= trainer.max_steps or not any(
        (timer.time_remaining() or 0) <= 0 for timer in timers
    ):
        return TrainerResult(best_step, steps, ())
    ended = f"trainer.max_time ended training after {steps} of {trainer.max_steps} steps"
    log.warning("%s", ended)
    return TrainerResult(best_step, steps, (f"{ended}: another machine ends elsewhere",))


def _drop_unusable(
    callbacks: Sequence[L.Callback], val_rows: int, gaussians: bool
) -> Sequence[L.Callback]:
    """Leave out callbacks that need validation rows, or Gaussians to edit, where there are none."""
    blind = (
        []
        if val_rows
        else [c for c in callbacks if str(getattr(c, "monitor", "")).startswith("val/")]
    )
    if blind:
        log.info(
            "without validation rows: no %s",
            ", ".join(type(callback).__name__ for callback in blind),
        )
    return [
        c for c in callbacks if c not in blind and (gaussians or not hasattr(c, "edits_gaussians"))
    ]


def _describe_lost_process(error: ProcessException, advice: str) -> str:
    """What was said by the process that failed, without its traceback; or which one was killed."""
    if isinstance(error, ProcessExitedException):
        how = error.signal_name or f"exit status {error.exit_code}"
        return (
            f"training process {error.error_index} ended by {how}, the others were stopped; "
            f"{advice}"
        )
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].partition("Error: ")[2] or lines[-1] if lines else type(error).__name__


def _quieten_lightning() -> None:
    """Lightning advertises and repeats what the progress line says; its warnings stay,
    but for a few.
    """
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # Its report was asked for
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    # Our error says it in one line
    logging.getLogger("torch.multiprocessing.spawn").setLevel(logging.ERROR)
    for pointless in (
        r".*isinstance\(treespec, LeafSpec\).*",  # between Lightning and torch
        r".*does not have many workers.*",  # data this small is faster without
        r".*callbacks used to create the checkpoint need to be provided.*",  # schedules may change
        r".*The dirpath has changed.*",  # a resumed run may have a directory of its own
        r".*recommended to use `self.log\(.*sync_dist=True.*",  # every device validates all rows
        r".*smaller than the logging interval.*",  # small campaigns have few batches
        r".*Checkpoint directory .* exists and is not empty.*",  # it is the run directory
    ):
        warnings.filterwarnings("ignore", pointless)

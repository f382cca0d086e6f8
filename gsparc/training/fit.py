"""One stage of gradient training under Lightning."""

from __future__ import annotations

import logging
import math
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.plugins.io import CheckpointIO

from gsparc.data.datamodule import MeasurementsModule
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.methods.method import FitContext
from gsparc.training.lightning_module import GaussianModule
from gsparc.training.time_budget import Budget, Stretched

LOG_EVERY = 10  # steps: Lightning spends a fifth of a step on logging two figures


# What conf/trainer/cpu.yaml says, for callers from Python.
DEFAULTS = partial(
    L.Trainer,
    accelerator="cpu",
    devices=1,
    max_steps=400,
    val_check_interval=100,
    num_sanity_val_steps=0,
    enable_progress_bar=False,
    enable_model_summary=False,
)


def total_steps(context: FitContext) -> int:
    """Steps that schedules are written for.

    Raises:
        ValueError: the Trainer is given no number of steps.
    """
    steps = (context.trainer or DEFAULTS).keywords.get("max_steps", -1)
    if type(steps) is not int or steps < 1:
        raise ValueError(f"trainer.max_steps={steps!r}: a whole number of at least 1 is needed")
    return steps


class _Stopped(BaseException):
    """Ends training from inside; Lightning would turn a KeyboardInterrupt into an exit without a word."""


class StopBetweenSteps(L.Callback):
    """An interrupt waits for the end of the step, so that the checkpoint it leaves is a whole state.

    A second interrupt does not wait, and leaves the checkpoint before.

    Args:
        file: the checkpoint written when stopped.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.requested = False

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        """Write the checkpoint and end training when asked to."""
        if self.requested:
            trainer.save_checkpoint(self.file)
            raise _Stopped

    @contextmanager
    def listening(self) -> Iterator[None]:
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


def run_stage(
    module: GaussianModule,
    data: Measurements,
    fold: Fold,
    context: FitContext,
    checkpoints: CheckpointIO,
) -> float:
    """Train `module` on `fold.train`, watching `fold.val`; returns the seconds spent learning [s].

    Raises:
        KeyboardInterrupt: stopped by the user; the message names the checkpoint to go on from.
    """
    folder, make = module.run_dir, context.trainer or DEFAULTS
    _quieten_lightning()
    stop = StopBetweenSteps(folder / "last.ckpt")
    callbacks, pace = list(context.callbacks()), module.pace
    if pace is not None:
        stretched = [Stretched(c, pace) if hasattr(c, "interval") else c for c in callbacks]
        callbacks = [Budget(pace), *stretched]
    for callback in callbacks:
        if isinstance(callback, L.callbacks.ModelCheckpoint) and callback.dirpath is None:
            callback.dirpath = str(folder)
    every = make.keywords.get("val_check_interval")
    every = every if type(every) is int else LOG_EVERY
    module.log_every = math.gcd(LOG_EVERY, every)  # a validation sees the figures of its own step
    per_epoch = max(1, len(fold.train) // context.batch_size)
    options: dict[str, Any] = {
        "log_every_n_steps": max(1, min(50, per_epoch) // module.log_every) * module.log_every,
        "check_val_every_n_epoch": None,  # validations are counted in steps
    }
    if not len(fold.val):
        options |= {"val_check_interval": None, "check_val_every_n_epoch": 1, "limit_val_batches": 0}
    if pace is not None:
        options["max_steps"] = -1
    trainer = make(
        max_epochs=-1,
        callbacks=[*callbacks, stop],
        logger=list(context.loggers) or False,
        plugins=[checkpoints],
        default_root_dir=folder,
        enable_checkpointing=any(isinstance(c, L.callbacks.ModelCheckpoint) for c in callbacks),
        **options,
    )
    batches = MeasurementsModule(data, fold, context.batch_size, context.seed)
    try:
        with stop.listening():
            trainer.fit(module, datamodule=batches, ckpt_path=context.resume, weights_only=True)
    except (_Stopped, SystemExit):  # Lightning's answer to a KeyboardInterrupt is SystemExit
        advice = f"go on with ckpt_path={stop.file}" if stop.file.exists() else "there is no checkpoint yet"
        raise KeyboardInterrupt(f"training was interrupted; {advice}") from None
    return module.train_seconds


def _quieten_lightning() -> None:
    """Lightning advertises and repeats what the progress line says; its warnings stay, but for six."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for pointless in (
        r".*isinstance\(treespec, LeafSpec\).*",  # between Lightning and torch
        r".*does not have many workers.*",  # data this small is faster without
        r".*callbacks used to create the checkpoint need to be provided.*",  # a rhythm may change
        r".*The dirpath has changed.*",  # a resumed run may have a directory of its own
        r".*smaller than the logging interval.*",  # small campaigns have few batches
        r".*Checkpoint directory .* exists and is not empty.*",  # it is the run directory
    ):
        warnings.filterwarnings("ignore", pointless)

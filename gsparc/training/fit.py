"""One stage of gradient training under Lightning."""

from __future__ import annotations

import logging
import math
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.io import CheckpointIO

from gsparc.data.datamodule import MeasurementsModule
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.training.lightning_module import GaussianModule
from gsparc.training.time_budget import Budget, Stretched

LOG_EVERY = 10  # steps: Lightning spends a fifth of a step on logging two figures


@dataclass(frozen=True)
class TrainerSettings:
    """How long and how training runs.

    Attributes:
        max_steps: optimiser steps.
        budget_s: seconds of training instead, over all stages; every schedule is stretched from `max_steps`
            to end with it. Null: `max_steps` decide.
        batch_size: samples per step.
        val_every: steps between validations.
        checkpoint_every: steps between `last.ckpt`.
        gradient_clip: largest gradient norm; null never clips.
        accelerator: Lightning's choice of device.
    """

    max_steps: int = 3000
    budget_s: float | None = None
    batch_size: int = 16
    val_every: int = 500
    checkpoint_every: int = 500
    gradient_clip: float | None = None
    accelerator: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("max_steps", "batch_size", "val_every", "checkpoint_every"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"trainer.{name}={value!r}: a whole number of at least 1 is needed")
        if self.budget_s is not None and not 0 < self.budget_s < float("inf"):
            raise ValueError(
                f"trainer.budget_s={self.budget_s!r}: a positive number of seconds is needed, or null"
            )


@dataclass
class Training:
    """What a run brings along; the method itself only knows how to learn.

    Attributes:
        settings: length and pace.
        seed: of initial parameters, data order and densification.
        callbacks: makes fresh Lightning callbacks.
        loggers: made once per run, closed by the caller.
        resume: checkpoint to go on from, or None.
        config_yaml: the whole configuration, stored in every checkpoint.
    """

    settings: TrainerSettings = field(default_factory=TrainerSettings)
    seed: int = 0
    callbacks: Callable[[], Sequence[L.Callback]] = tuple
    loggers: Sequence[Logger] = ()
    resume: Path | None = None
    config_yaml: str = ""


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
    training: Training,
    checkpoints: CheckpointIO,
    resume: Path | None,
) -> float:
    """Train `module` on `fold.train`, watching `fold.val`; returns the seconds spent learning [s].

    Raises:
        KeyboardInterrupt: stopped by the user; the message names the checkpoint to go on from.
    """
    settings, folder = training.settings, module.run_dir
    _hush()
    last = L.callbacks.ModelCheckpoint(
        folder,
        filename="last",
        every_n_train_steps=settings.checkpoint_every,
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
    stop = StopBetweenSteps(folder / "last.ckpt")
    callbacks, pace = list(training.callbacks()), module.pace
    if pace is not None:
        stretched = [Stretched(c, pace) if hasattr(c, "interval") else c for c in callbacks]
        callbacks = [Budget(pace), *stretched]
    module.log_every = math.gcd(
        LOG_EVERY, settings.val_every
    )  # a validation sees the figures of its own step
    per_epoch = max(1, len(fold.train) // settings.batch_size)
    trainer = L.Trainer(
        accelerator=settings.accelerator,
        devices=1,
        max_steps=settings.max_steps if pace is None else -1,
        max_epochs=-1,
        callbacks=[*callbacks, stop, last],
        logger=list(training.loggers) or False,
        plugins=[checkpoints],
        gradient_clip_val=settings.gradient_clip,
        val_check_interval=settings.val_every if len(fold.val) else None,
        check_val_every_n_epoch=None if len(fold.val) else 1,
        limit_val_batches=None if len(fold.val) else 0,
        num_sanity_val_steps=0,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=max(1, min(50, per_epoch) // module.log_every) * module.log_every,
        default_root_dir=folder,
    )
    batches = MeasurementsModule(data, fold, settings.batch_size, training.seed)
    try:
        with stop.listening():
            trainer.fit(module, datamodule=batches, ckpt_path=resume, weights_only=True)
    except (_Stopped, SystemExit):  # Lightning's answer to a KeyboardInterrupt is SystemExit
        advice = f"go on with ckpt_path={stop.file}" if stop.file.exists() else "there is no checkpoint yet"
        raise KeyboardInterrupt(f"training was interrupted; {advice}") from None
    return module.train_seconds


def _hush() -> None:
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

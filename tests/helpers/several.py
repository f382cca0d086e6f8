"""Trainings with densification in several processes."""

import hashlib
import os
import signal
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from modules import module
from torch import distributed

from gsparc.callbacks import Checkpoint, Densify, OpacityReset
from gsparc.data.query import Batch
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.datamodule import Loaded
from gsparc.field.gradient_stage import DEFAULTS, interruptible, make_trainer
from gsparc.field.module import GaussianModule
from gsparc.field.optimizer import OptimizerSettings
from gsparc.ops import Pose
from gsparc.training.context import FitContext
from gsparc.training.stopwatch import Stopwatch

BATCH = 7  # no multiple of two processes, nor a divisor of the rows


class Doubles(Loaded):
    """Batches in float64."""

    def transfer_batch_to_device(
        self, batch: Batch, device: torch.device, dataloader_idx: int
    ) -> Batch:
        rx = Pose(batch.rx.position.double(), batch.rx.rotation.double())
        return replace(batch, tx=batch.tx.double(), target=batch.target.double(), rx=rx).to(device)


class Alike(L.Callback):
    """Compares what all processes hold, every 10 steps: parameters, moments,
    ids and gathered statistics.
    """

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *unused: Any) -> None:
        if trainer.global_step % 10 or not distributed.is_initialized():
            return
        (densify,) = [c for c in trainer.callbacks if isinstance(c, Densify)]
        moments = [
            list(state.values())
            for state in map(trainer.optimizers[0].state.get, module.parameters())
            if state
        ]
        held = [*module.state_dict().values(), *densify.statistics.values(), *chain(*moments)]
        text = b"".join(tensor.detach().double().numpy().tobytes() for tensor in held)
        found: list[Any] = [None] * trainer.world_size
        distributed.all_gather_object(found, hashlib.sha256(text).hexdigest())
        if len(set(found)) > 1:
            raise ValueError(f"processes differ at step {trainer.global_step}")


class Kill(L.Callback):
    """The second process ends without a word at a step."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_start(self, trainer: L.Trainer, *unused: Any) -> None:
        if trainer.global_step == self.step and trainer.global_rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)


def densifying() -> list[L.Callback]:
    """Densification, pruning and reset, several times in 200 steps; watched for differences."""
    return [
        Densify(20, 150, 20, grad_threshold=1e-5, max_gaussians=60, min_opacity=0.02),
        OpacityReset(60, 150),
        Alike(),
    ]


def trained(
    data: Measurements,
    folder: Path,
    devices: int,
    steps: int = 200,
    double: bool = True,
    more: Sequence[L.Callback] = (),
    resume: Path | None = None,
) -> GaussianModule:
    """A small field after `steps`, with one device in this process,
    with more in processes of their own.

    `last.ckpt` is left after every seventh step.
    """
    torch.set_num_threads(1)
    made = module(data, folder)
    del made.log
    made.total_steps = steps
    made.rates = OptimizerSettings(
        eps=1e-6
    )  # with less, Adam makes a whole step of a gradient that is rounding
    fold = Fold(np.arange(30), np.arange(0), np.arange(30, 40))
    shown = (Doubles if double else Loaded)(data, BATCH)
    last = Checkpoint(7)
    options = partial(
        DEFAULTS, max_steps=steps, devices=devices, strategy="ddp_fork" if devices > 1 else "auto"
    )
    context = FitContext(
        folder,
        batch_size=BATCH,
        datamodule=shown,
        trainer=options,
        resume=resume,
        callbacks=lambda: [*densifying(), last, *more],
    )
    L.seed_everything(0, verbose=False)
    trained = made.double() if double else made
    trainer, batches = make_trainer(trained, data, fold, context, TorchCheckpointIO(), Stopwatch())
    with interruptible(trainer, batches):
        trainer.fit(trained, datamodule=batches, ckpt_path=resume, weights_only=True)
    return made

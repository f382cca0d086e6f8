"""A method's network under Lightning's Trainer, and its checkpoints inside ours: one file that
`gsparc.load` reads and `ckpt_path=` resumes from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback
from lightning.pytorch.plugins.io import CheckpointIO

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.gradient_stage import (
    TrainerResult,
    interruptible,
    make_trainer,
    read_trainer_result,
)
from gsparc.field.module import NetworkModule
from gsparc.models import checkpoint
from gsparc.models.checkpoint import read_interrupted
from gsparc.models.method import Method
from gsparc.training.context import FitContext
from gsparc.training.stopwatch import Stopwatch


class GsparcCheckpointIO(CheckpointIO):
    """Writes a method's checkpoint with the trainer's state beside it, atomically.

    Args:
        method: what is being trained.
        config_yaml: the whole configuration as text.
        marks: what else a resumed run must know (which stage, seconds spent before it).
    """

    def __init__(self, method: Method, config_yaml: str, marks: Mapping[str, Any]) -> None:
        self.method, self.config_yaml, self.marks = method, config_yaml, dict(marks)

    def save_checkpoint(
        self, trainer_state: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write atomically; nowhere where a fit has no folder."""
        extra = {"trainer": trainer_state, **self.marks}
        if Path(path).parent != Path():
            checkpoint.save(Path(path), self.method, self.config_yaml, extra)

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Return the trainer's part of a checkpoint.

        Raises:
            ValueError: when the file holds a finished model without a trainer's state.
        """
        return read_interrupted(Path(path)).extra["trainer"]

    def remove_checkpoint(self, path: Any) -> None:
        """Delete a superseded checkpoint."""
        Path(path).unlink(missing_ok=True)


def train_module(
    method: Method,
    module: NetworkModule,
    data: Measurements,
    fold: Fold,
    context: FitContext,
    watch: Stopwatch,
    marks: Mapping[str, Any],
    keeping: Sequence[Callback] = (),
) -> TrainerResult:
    """Train what a method made, and return the steps that were taken and kept.

    Args:
        method: as `last.ckpt` stores it.
        module, data, fold, context, watch, keeping: see `make_trainer`.
        marks: see `GsparcCheckpointIO`.

    Raises:
        KeyboardInterrupt, RuntimeError: see `interruptible`.
    """
    files = GsparcCheckpointIO(method, context.config_yaml, marks)
    trainer, batches = make_trainer(module, data, fold, context, files, watch, keeping)
    with interruptible(trainer, batches):
        trainer.fit(module, datamodule=batches, ckpt_path=context.resume, weights_only=True)
    return read_trainer_result(trainer, watch)

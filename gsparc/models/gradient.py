"""Steps by gradient under Lightning's Trainer, and its checkpoints inside ours: one file that
`gsparc.load` reads and `ckpt_path=` resumes from. Apart from the fields, which answer without
Lightning and the two seconds that importing it takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from gsparc.field.keep_best import PATIENCE, KeepBest, StopAt
from gsparc.field.module import GaussianModule, NetworkModule
from gsparc.models import checkpoint
from gsparc.models.checkpoint import read_interrupted
from gsparc.models.method import Method
from gsparc.training.context import FitContext
from gsparc.training.stopwatch import Stopwatch

if TYPE_CHECKING:
    from gsparc.models.splat.method import LearnedField, Stage


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


def make_module(method: LearnedField, steps: int = 1, run_dir: Path = Path()) -> GaussianModule:
    """Return what Lightning trains: the model, its loss and its rates,
    with schedules over `steps`.
    """
    solved = method.choices is not None and method.choices.closed_form
    rates = method.rates.after_closed_form(steps) if solved else method.rates
    module = GaussianModule(method.fitted_model(), method.loss, rates, steps, run_dir)
    module.solved = solved
    return module


def take_steps(
    method: LearnedField,
    stage: Stage,
    data: Measurements,
    watch: Stopwatch,
    marks: Mapping[str, Any],
) -> TrainerResult:
    """Take a stage's steps from the model as it is.

    Args:
        method: whose model is trained.
        stage, data, watch: of the fit.
        marks: what an interrupted run must know, with `earlier_s` of training before these steps.
    """
    module = make_module(method, stage.steps, stage.context.run_dir)
    assert method.choices is not None
    module.prepared_seconds = marks["earlier_s"]
    module.start = f"init={method.choices.init}" + (", closed form" if module.solved else "")
    keeping: list[Callback] = []
    if stage.name == "train" and method.keep_best:
        keeping = [KeepBest(PATIENCE if stage.watched else None)]
    elif stage.name != "train" and marks["paying"] is not None:
        keeping = [StopAt(marks["paying"])]
    return train_module(method, module, data, stage.fold, stage.context, watch, marks, keeping)

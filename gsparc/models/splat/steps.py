"""Gradient steps of a splatted field. Apart from the field, which answers without Lightning and
the two seconds that importing it takes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning.pytorch import Callback, seed_everything

from gsparc.data.schema import Measurements
from gsparc.field.gradient_stage import TrainerResult
from gsparc.field.keep_best import PATIENCE, KeepBest, StopAt
from gsparc.field.module import GaussianModule
from gsparc.models.gradient import train_module
from gsparc.training.stopwatch import Stopwatch

if TYPE_CHECKING:
    from gsparc.models.splat.method import LearnedField, Stage

__all__ = ["make_module", "seed_everything", "take_steps"]


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

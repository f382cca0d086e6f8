"""Contexts of short trainings: few steps, small batches, the callbacks a test wants."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from campaigns import brief, compose

from gsparc.callbacks import Checkpoint
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.load import load, split_for
from gsparc.field.gradient_stage import DEFAULTS
from gsparc.models.method import Method
from gsparc.models.registry import build
from gsparc.training.context import FitContext


def short(
    run_dir: Path,
    steps: int,
    batch_size: int = 8,
    callbacks: Callable[[], Sequence[Any]] = tuple,
    every: int | None = None,
    validate_every: int = 500,
    **more: Any,
) -> FitContext:
    """`steps` optimiser steps; `last.ckpt` after each `every` of them."""

    def made() -> list[Any]:
        return [*callbacks(), *([Checkpoint(every)] if every else [])]

    trainer = partial(DEFAULTS, max_steps=steps, val_check_interval=validate_every)
    return FitContext(run_dir, batch_size=batch_size, trainer=trainer, callbacks=made, **more)


def loaded(file: Path) -> tuple[Measurements, Fold]:
    """A user's measurements and their random fold."""
    data = load({"name": "own", "file": str(file)})
    return data, split_for({"name": "random"}, data).folds[0]


def trained(
    file: Path, folder: Path, steps: int, *overrides: str, **more: Any
) -> tuple[Method, Measurements]:
    """The splatted field of `brief`, after so many steps on a user's file;
    `more` is for `short`.
    """
    data, fold = loaded(file)
    method = build(compose(*brief(file, "model.refit=false", *overrides)).model).create_for(data)
    method.fit(data, fold, short(folder, steps, **more))
    return method, data

"""Fit a method on every fold of a split, score it, time it: of a study, a comparison or a run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from lightning import Callback
from omegaconf import DictConfig, OmegaConf

from gsparc.data.executor import run_each, uses_other_processes
from gsparc.data.load import split_settings
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.console import to_dict
from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.scores import score_methods
from gsparc.models import fitting
from gsparc.models.method import Method, MethodFactory
from gsparc.models.per_station import wrap_per_station
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import NO_COST, Cost


def fit_context(config: DictConfig, **others: Any) -> FitContext:
    """Return the context of a fit as a composed configuration says, and what is given.

    Args:
        config: its seed, effort, split, `init_from`, batch size, Trainer and callbacks.
        **others: of `FitContext`: `run_dir`, `datamodule`, `loggers`, `resume`.
    """
    init_from = config.get("init_from")
    return FitContext(
        **effort_settings(config),
        init_from=None if init_from is None else Path(init_from),
        batch_size=config.dataset.get("batch_size", 16),
        trainer=instantiate(config.trainer, _partial_=True),
        callbacks=partial(build_callbacks, config.get("callbacks")),
        config_yaml=OmegaConf.to_yaml(config, resolve=True),
        **others,
    )


def effort_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a context decides how much is searched, and on which rows; it makes no object."""
    split = config.get("split")
    own = split if split is None or isinstance(split, dict) else to_dict(split)
    return {
        # `get`: configurations of other commands, and older ones, lack some of these keys.
        "seed": int(config.get("seed", 0)), "effort": float(config.get("effort", 1.0)),
        "stations": config.get("stations", "auto"), "split": own and split_settings(own),
    }  # fmt: skip


def build_callbacks(nodes: Mapping[str, Any] | None) -> list[Callback]:
    """Build every callback of the group `callbacks` that was not set to null."""
    return [instantiate(node) for node in (nodes or {}).values() if node is not None]


@dataclass(frozen=True)
class FoldFits:
    """A method after it was fitted on every fold.

    Attributes:
        methods: one per fold.
        train_s: seconds of each fit [s], without validation.
        train_cpu_s: processor seconds of each fit, of all threads [s]: a busy machine does not inflate them.
        notes: what the first fold's fit said.
        cost: of all fits together.
    """

    methods: tuple[Method, ...]
    train_s: tuple[float, ...]
    train_cpu_s: tuple[float, ...]
    notes: tuple[str, ...]
    cost: Cost = NO_COST

    def figures(self, data: Measurements, split: Split) -> dict[str, float | None]:
        """Return accuracies pooled over folds, of what it learned from or of other data, as moved queries."""
        return pool_figures(score_methods(self.methods, data, split), data, split)


def fold_contexts(whole: FitContext, split: Split) -> list[FitContext]:
    """Return the contexts of its folds, each with a folder and series of figures of its own."""
    return [whole.for_part(f"fold{number}") for number in range(len(split.folds))]


def fit_folds(
    factory: MethodFactory, data: Measurements, split: Split, contexts: Sequence[FitContext], *,
    learned: Callable[[Measurements, Fold], tuple[Measurements, Fold]] | None = None,
    keep: Callable[[int, Method, FitReport], None] | None = None,
) -> FoldFits:  # fmt: skip
    """Fit an unfitted method on every fold; `FoldFits.figures` scores them together.

    Args:
        factory: an unfitted method, or what chooses one.
        data, split: learned from `train` and `val` of each fold.
        contexts: of each fold's fit.
        learned: what is learned from instead, such as displaced or fewer measurements.
        keep: called after each fit with the fold's number, the method and its report.

    Raises:
        ValueError: the method does not serve these data.
        RuntimeError: training diverged.
    """
    # Pickled for other processes, they would write into this run's files from several at once.
    if uses_other_processes() and len(split.folds) > 1:  # loggers and loaders of a run are of its process
        contexts = [replace(context, loggers=(), datamodule=None) for context in contexts]

    def fitted(number: int) -> tuple[Method, FitReport, float]:
        fold = split.folds[number]
        there, rows = (data, fold) if learned is None else learned(data, fold)
        # process_time counts all threads of this process, waiting for others excluded.
        before = time.process_time()
        # Stations are counted in the data that are learned from, which `learned` may have changed.
        unfitted = wrap_per_station(factory, there)
        method, report = fitting.fit_or_resume(unfitted, there, rows, contexts[number])
        return method, report, time.process_time() - before

    by_fold: dict[int, tuple[Method, FitReport, float]] = {}
    # Folds may end in any order: kept at once, so that an interrupt loses only those at work.
    for number, one in run_each(fitted, range(len(split.folds)), "folds"):
        by_fold[number] = one
        if keep is not None:
            keep(number, *one[:2])
    methods, reports, processor = zip(*(by_fold[number] for number in sorted(by_fold)), strict=True)
    return FoldFits(
        # Notes of the first fold stand for all: the others differ in numbers.
        methods, tuple(one.seconds for one in reports), processor, reports[0].notes,
        sum((one.cost for one in reports), NO_COST),
    )  # fmt: skip

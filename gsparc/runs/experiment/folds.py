"""Fit a method on every fold of a split, and keep each fold as it ends."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from hydra.utils import instantiate
from lightning import Callback

from gsparc.base.errors import Caution, Severe
from gsparc.base.executor import run_each, uses_other_processes
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.datasets.load import split_settings
from gsparc.evaluation.console import to_dict
from gsparc.models import checkpoint, fitting
from gsparc.models.method import Method, MethodFactory
from gsparc.models.per_station import wrap_per_station
from gsparc.prediction.hearing import Hearing
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import NO_COST, Cost

log = logging.getLogger("gsparc.models")  # of which the console shows warnings alone


def effort_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a context decides how much is searched, and on which rows;
    it makes no object.
    """
    split = config.get("split")
    values = split if split is None or isinstance(split, dict) else to_dict(split)
    return {
        # `get`: configurations of other commands, and older ones, lack some of these keys.
        "seed": int(config.get("seed", 0)),
        "effort": float(config.get("effort", 1.0)),
        "stations": config.get("stations", "auto"),
        "split": values and split_settings(values),
    }


def build_callbacks(nodes: Mapping[str, Any] | None) -> list[Callback]:
    """Build every callback of the group `callbacks` that was not set to null."""
    return [instantiate(node) for node in (nodes or {}).values() if node is not None]


@dataclass(frozen=True)
class FoldFits:
    """A method after it was fitted on every fold.

    Attributes:
        methods: one per fold.
        train_s: seconds of each fit [s], without validation.
        train_cpu_s: processor seconds of each fit, of all threads [s]: a busy machine does not
            inflate them.
        notes: what the first fold's fit said.
        learned: rows of all folds that were learned from, by their subset.
        cost: of all fits together.
    """

    methods: tuple[Method, ...]
    train_s: tuple[float, ...]
    train_cpu_s: tuple[float, ...]
    notes: tuple[str, ...]
    learned: dict[str, int]
    cost: Cost = NO_COST

    def facts(self) -> dict[str, Any]:
        """Return what a summary says of the fits."""
        # Those were warnings
        notes = [note for note in self.notes if not isinstance(note, Caution)]
        facts = {
            "time/train_cpu_s": fmean(self.train_cpu_s),
            "model/learned": "\n".join(notes) or None,
            **{f"split/{subset}": count for subset, count in self.learned.items()},
        }
        facts["model/refused"] = (
            "\n".join(note for note in self.notes if isinstance(note, Severe)) or None
        )
        if self.cost.stages:
            facts |= {"time/cost": self.cost.describe(), "time/unused_s": self.cost.unused_s}
        return facts


def folds_to_resume(
    ckpt_path: str | None, factory: MethodFactory, split: Split
) -> list[Path | None]:
    """Return what each fold goes on from, a file or a folder;
    each of several has its own in the run's.

    Raises:
        ValueError: a file that belongs to no fold, or a method that trains in one piece.
    """
    path, folds = None if ckpt_path is None else Path(ckpt_path), len(split.folds)
    # A folder has finished parts
    if path is not None and not path.is_dir() and not factory.resumable:
        raise ValueError(
            f"ckpt_path: {factory.name} trains in one piece; start again without ckpt_path"
        )
    if path is None or folds == 1:
        return [path] * folds
    run = fitting.run_folder(path, fitting.FOLDS)
    folders = [run / f"fold{number}" for number in range(folds)]
    # A file that belongs to no fold says nothing of where the other folds stand.
    if path.is_file() and not {*folders} & {*path.parents} and not list(run.glob("fold*")):
        raise ValueError(
            f"ckpt_path={path}: split={split.name} has {folds} folds, give the run's folder"
        )
    return [folder if folder.is_dir() else None for folder in folders]


def fold_contexts(
    whole: FitContext, split: Split, resumes: Sequence[Path | None] | None = None
) -> list[FitContext]:
    """Return the contexts of its folds, each of several with a folder and series
    of figures of its own.
    """
    count = len(split.folds)
    contexts = (
        [whole.for_part(f"fold{number}") for number in range(count)] if count > 1 else [whole]
    )
    resumed = zip(contexts, resumes or [None] * count, strict=True)
    return [replace(context, resume=resume) for context, resume in resumed]


def checkpoints(contexts: Sequence[FitContext]) -> tuple[Path, ...]:
    """Return the files of the folds' models."""
    return tuple(context.run_dir / checkpoint.MODEL for context in contexts)


def save_fold_checkpoint(
    split: Split,
    contexts: Sequence[FitContext],
    run_id: str,
    number: int,
    data: Measurements,
    fold: Fold,
    fitted: Method,
    report: FitReport,
) -> None:
    """Write the checkpoint of a fold as soon as it is fitted, and say what its fit notes."""
    context = contexts[number]
    for note in report.notes:
        log.log(logging.WARNING if isinstance(note, Caution) else logging.INFO, "%s", note)
    extra = fitting.run_extra(report, data, fold, context)
    extra |= Hearing.from_learned(data, fold.learned()).to_extra()
    extra |= {
        "fold": number,
        "split_sha256": split.sha256,
        "run_id": run_id,
        "tested": len(fold.test),
    }
    extra["read_notes"] = (
        [] if context.datamodule is None else [*map(str, context.datamodule.notes)]
    )
    checkpoint.save(context.run_dir / checkpoint.MODEL, fitted, context.config_yaml, extra)


def end_curves(
    contexts: Sequence[FitContext],
    seconds: Sequence[float],
    columns: Mapping[str, Any],
    eval_on: str,
) -> None:
    """End the curve of every fold with its seconds and the error of what was fitted
    on the rows scored.

    `columns` are those of `per_sample.csv`.
    """
    squared = columns["error_db"] ** 2 if "error_db" in columns else columns.get("mse")
    for number, (context, spent) in enumerate(zip(contexts, seconds, strict=True)):
        fold_squares = [] if squared is None else squared[columns["fold"] == number]
        error = float(np.nanmean(fold_squares)) if np.isfinite(fold_squares).any() else None
        context.log_curve(spent, f"{eval_on} rows", error)


def fit_folds(
    factory: MethodFactory,
    data: Measurements,
    split: Split,
    contexts: Sequence[FitContext],
    *,
    keep: Callable[[int, Measurements, Fold, Method, FitReport], None] | None = None,
) -> FoldFits:
    """Fit an unfitted method on every fold.

    Args:
        factory: an unfitted method, or what chooses one.
        data, split: learned from `train` and `val` of each fold.
        contexts: of each fold's fit.
        keep: called after each fit with the fold's number, what it learned from, the method and its
            report.

    Raises:
        ValueError: the method does not serve these data.
        RuntimeError: training diverged.
    """
    # Pickled for other processes, they would write into this run's files from several at once.
    # Loggers and loaders of a run are of its process
    if uses_other_processes() and len(split.folds) > 1:
        contexts = [replace(context, loggers=(), datamodule=None) for context in contexts]

    def fitted(number: int) -> tuple[Method, FitReport]:
        whole = wrap_per_station(factory, data)
        return fitting.fit_or_resume(whole, data, split.folds[number], contexts[number])

    by_fold: dict[int, tuple[Method, FitReport]] = {}
    try:
        # Folds may end in any order: kept at once, so that an interrupt loses only those at work.
        for number, fit in run_each(fitted, range(len(split.folds)), "folds"):
            by_fold[number] = fit
            if keep is not None:
                keep(number, data, split.folds[number], *fit)
    except KeyboardInterrupt as stopped:
        if len(contexts) == 1:
            raise
        cause, run_dir = (
            str(stopped).partition("; ")[0] or "interrupted",
            contexts[0].run_dir.parent,
        )
        raise KeyboardInterrupt(f"{cause}; go on with ckpt_path={run_dir}") from None
    methods, reports = zip(*(by_fold[number] for number in sorted(by_fold)), strict=True)
    return FoldFits(
        # Notes of the first fold stand for all: the others differ in numbers.
        methods,
        tuple(report.seconds for report in reports),
        tuple(report.cpu_s for report in reports),
        reports[0].notes,
        {name: sum(len(getattr(f, name)) for f in split.folds) for name in ("train", "val")},
        sum((report.cost for report in reports), NO_COST),
    )

"""Baselines beside which a method is shown: which serve the data, and their fits."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import DictConfig

from gsparc.data.instantiate import config_node, import_target
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.console import to_dict
from gsparc.evaluation.experiment.folds import fit_folds
from gsparc.evaluation.scores import Scores, score_methods
from gsparc.models.method import Method, MethodFactory
from gsparc.models.registry import all_methods, method_class, plain_methods
from gsparc.prediction.hearing import Hearing
from gsparc.training.context import FitContext, FitReport

log = logging.getLogger(__name__)


def baselines_for(data: Measurements, split: Split) -> tuple[str, ...]:
    """Return names of all plain methods that serve these measurements and rows."""
    return tuple(
        name
        for name in plain_methods()
        if all(method_class(name).stands_beside(data, fold) for fold in split.folds)
    )


def same_as_baseline(config: DictConfig, method: MethodFactory) -> str | None:
    """Return the name of a run's method where a baseline of that name would be fitted in the same way."""
    plainly = config.eval_on != "val" and config.get("stations", "auto") == "auto" and not method.takes_effort
    kind = all_methods().get(method.name)
    same = kind is not None and to_dict(config.model) == config_node(import_target(kind))
    return method.name if plainly and same else None


@dataclass(frozen=True)
class FittedBaseline:
    """A baseline on every fold of a split.

    Attributes:
        methods: one fitted method per fold.
        scores: pooled results.
        train_s: fitting time of each fold [s].
    """

    methods: tuple[Method, ...]
    scores: Scores
    train_s: tuple[float, ...]


def fit_baseline(
    name: str, data: Measurements, split: Split, eval_on: str = "test",
    learned: tuple[Measurements, Split] | None = None, hearing: Sequence[Hearing] | None = None,
) -> FittedBaseline:  # fmt: skip
    """Fit the baseline `name` with its default settings on each fold, and score it.

    Args:
        name: as in `gsparc.models.registry.all_methods()`.
        data: the dataset.
        split: folds; baselines learn from train and val rows, or from train rows when `val` is scored.
        eval_on: `train`, `val` or `test`.
        learned: other measurements to learn from, and the folds of these; None: `data` and `split`.
        hearing: see `score_methods`.
    """
    learned_data, before = learned or (data, split)
    if eval_on == "val" and learned is None:  # learned from as methods do, but where they are scored
        before = replace(before, folds=tuple(replace(fold, val=fold.val[:0]) for fold in before.folds))

    def say(number: int, there: Measurements, rows: Fold, method: Method, report: FitReport) -> None:
        for note in report.notes:
            log.info("fold %d: %s", number, note)

    contexts = [FitContext(Path())] * len(before.folds)
    fits = fit_folds(method_class(name)(), learned_data, before, contexts, keep=say)
    scores = score_methods(fits.methods, data, split, eval_on, learned, hearing=hearing)
    return FittedBaseline(fits.methods, scores, fits.train_s)

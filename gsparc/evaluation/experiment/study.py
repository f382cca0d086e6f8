"""Variants of one model under conditions of the data: every pair is fitted, scored and timed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gsparc.data.executor import run_all
from gsparc.data.files import SUMMARY
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.experiment.folds import FoldFits, fit_folds, fold_contexts
from gsparc.evaluation.ledger import State, run_once
from gsparc.evaluation.metric_formats import deciding_figure
from gsparc.evaluation.results import facts_under
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.models import checkpoint, loading
from gsparc.models.method import MethodFactory
from gsparc.models.refined_places import move_rows
from gsparc.prediction.pareto import defined_figure
from gsparc.prediction.timing import ClockSettings, p50_p95, query_calls, time_interleaved
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

# Part of the message, since methods raise a plain ValueError for all that they refuse.
REFUSED = "not possible"  # in the error of an effect that the data do not allow


@dataclass(frozen=True)
class Condition:
    """One state of the data.

    Attributes:
        what: what was changed: `none`, places of a `query` or in training (`train`; `train_known`: by a known
            error), `directions` of arrival, or how many measurements one may `keep`.
        amount: by how much: metres, degrees, or a share up to 1 and a number of rows above.
    """

    what: str = "none"
    amount: float = 0.0

    def __str__(self) -> str:
        return self.what if self.what == "none" else f"{self.what} {self.amount:g}"

    @property
    def learned(self) -> Condition:
        """Return the condition whose training stands for this one's."""
        # A query's error changes nothing that is learned: one training serves all of them.
        return Condition() if self.what == "query" else self

    def model(self, folder: Path) -> Path:
        """Return where the model that was trained so is, in the folder of its cell."""
        return folder / str(self.learned).replace(" ", "-") / checkpoint.MODEL

    def row(self, facts: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        """Return its part of a cell's summary."""
        names = {"figure": facts["figure"], "model": str(self.model(folder))}
        return {**asdict(self), **names, **facts_under(facts, str(self))}

    def change_training(self, data: Measurements, fold: Fold, seed: int) -> tuple[Measurements, Fold]:
        """Return data and rows of a fold under this condition."""
        if self.what == "keep":
            return data, thin_fold(fold, self.amount, seed)
        if self.what == "directions":
            return add_direction_errors(data, self.amount, seed), fold
        if self.what not in ("train", "train_known"):
            return data, fold
        # Both ends of learning: validation rows are measured with the same instrument.
        moved = add_position_errors(data, np.concatenate([fold.train, fold.val]), self.amount, seed)
        known = np.full(len(data), self.amount) if self.what == "train_known" else moved.position_std
        return replace(moved, position_std=known), fold


ROW = (
    "variant", "what", "amount", "effects", "rows", "figure", "value", "spread", "train_s", "train_cpu_s",
    "query_ms", "query_p95_ms",
)  # fmt: skip


@dataclass(frozen=True)
class Study:
    """What is compared.

    Attributes:
        variants: factories of methods by name, in the order of the table.
        conditions: each variant is fitted once per condition that changes what is learned from.
        rounds: trainings of each, in turns; round r uses seed + r.
        seed: of the first round.
        clock: of the queries.
    """

    variants: Mapping[str, Callable[[], MethodFactory]]
    conditions: Sequence[Condition] = (Condition(),)
    rounds: int = 1
    seed: int = 0
    clock: ClockSettings = field(default_factory=ClockSettings)

    def run(self, data: Measurements, split: Split, context: FitContext, state: State) -> pd.DataFrame:
        """Fit, score and time everything; a variant that the data do not allow is left out.

        A round of a variant is a cell with a folder of its own, which is done once.

        Args:
            data, split: as they are before any condition.
            context: of every fit, but for its folder and seed.
            state: what results depend on; stored ones of another state are not reused.

        Returns:
            A row per variant and condition, columns `ROW` (those of `study.csv`).
            `effects` that the variant computes; measurements (`rows`) that it learned from, mean over folds.
            `figure`, `value`: accuracy on the test rows, mean over rounds; `spread`: standard deviation.
            `train_s`, `train_cpu_s`: training of one model by the clock and of the processor, median over
            rounds [s].
            `query_ms`, `query_p95_ms`: single queries, timed in turns with all other rows' [ms].
            NaN where there is no spread.

        Raises:
            ValueError: no variant can be trained here.
        """

        def done(cell: tuple[str, int]) -> list[dict[str, Any]] | str:
            """A row per condition, or why the data do not allow the variant."""
            variant, turn = cell
            # Each round has another seed, of the draws of errors as well as of the method.
            own = replace(context, run_dir=context.run_dir / variant / str(turn), seed=self.seed + turn)
            work = partial(self._fit_and_score, variant, data, split, own)
            try:
                facts = run_once(own.run_dir, state, work)
            # Only what the data do not allow: any other error is a mistake and ends the study.
            except ValueError as refused:
                if REFUSED not in str(refused):
                    raise
                return str(refused)
            return [{"variant": variant, **one.row(facts, own.run_dir)} for one in self.conditions]

        cells = [(variant, turn) for turn in range(self.rounds) for variant in self.variants]
        found = run_all(done, cells, "rounds of variants, possible here or not")
        refused = {cell[0]: why for why, cell in zip(found, cells, strict=True) if isinstance(why, str)}
        rows = [row for one in found if not isinstance(one, str) for row in one]
        if not rows:
            raise ValueError(next(iter(refused.values())))
        for variant, why in refused.items():
            log.info("%s is left out: %s", variant, why)
        return self._table(pd.DataFrame(rows), data, split)

    def _fit_and_score(
        self, variant: str, data: Measurements, split: Split, context: FitContext, left: str | None
    ) -> None:
        """One training per condition that changes what is learned from, scored under all of them."""
        facts, fits, seed = dict[str, Any](), dict[Condition, FoldFits](), context.seed
        for condition in self.conditions:
            learned = condition.learned
            if learned not in fits:
                file = learned.model(context.run_dir)
                here = data, split, fold_contexts(replace(context, run_dir=file.parent), split)
                learned_from = partial(learned.change_training, seed=seed)
                fits[learned] = fit_folds(self.variants[variant](), *here, learned=learned_from)
                # Without the configuration of the study: a variant has other settings.
                extra = {"fold": 0, "split_sha256": split.sha256}
                checkpoint.save(file, fits[learned].methods[0], "", extra)
            outcome, asked = fits[learned], data
            if condition.what == "query":
                tested = np.concatenate([fold.test for fold in split.folds])
                asked = add_position_errors(data, tested, condition.amount, seed)
            figures = outcome.figures(asked, split)
            # Where rows were silent they count, as in every other table.
            figure = deciding_figure(figures, data.site.scored)
            folds = [condition.change_training(data, fold, seed)[1] for fold in split.folds]
            own = {
                "rows": float(np.mean([len(fold.train) + len(fold.val) for fold in folds])),
                "value": defined_figure(figures, figure), "train_s": float(np.mean(outcome.train_s)),
                "train_cpu_s": float(np.mean(outcome.train_cpu_s)),
                "effects": str(outcome.methods[0].effects or "none").replace("+", ", "),
            }  # fmt: skip
            facts |= {"figure": figure, **{f"{condition}/{name}": value for name, value in own.items()}}
            log.info(
                "%s%s, round %d of %d: %s %.4g after %.3g s of training a fold",
                variant, "" if condition == Condition() else f", {condition}",
                seed - self.seed + 1, self.rounds, figure, own["value"], own["train_s"],
            )  # fmt: skip
        write_summary(context.run_dir / SUMMARY, {"seed": seed, **facts, **provenance()})

    def _table(self, cells: pd.DataFrame, data: Measurements, split: Split) -> pd.DataFrame:
        """Rounds put together, and the models of the last one timed."""
        # The model of the last round is timed: rounds differ in weights, not in size.
        last = {name: (name, "last") for name in ("effects", "rows", "figure", "model")}
        median = {name: (name, "median") for name in ("train_s", "train_cpu_s")}
        groups = cells.groupby(["variant", "what", "amount"], sort=False)
        rows = groups.agg(value=("value", "mean"), spread=("value", "std"), **last, **median).reset_index()
        # A method that was only asked elsewhere is the same on the clock: it is timed once.
        # A dictionary by file: conditions that share a training share its model and its time.
        methods = {
            file: loading.rebuild_method(self.variants[variant](), checkpoint.read(file))
            for file, variant in zip(rows.model, rows.variant, strict=True)
        }
        times = time_interleaved(query_calls(methods, data, split.folds[0].test), self.clock)
        rows[["query_ms", "query_p95_ms"]] = [p50_p95(times[file]) for file in rows.model]
        return rows[list(ROW)]


@dataclass(frozen=True)
class DataChanges:
    """What a study changes about the data, one thing at a time; nothing: the variants alone are compared.

    Attributes:
        title: of its table and figure.
        errors_m: standard deviations of each coordinate of places [m].
        errors_deg: of directions of arrival about each of two axes, where receivers measured them [degrees].
        train_errors: whether training positions are disturbed, too; else those of queries alone.
        keep: training sets, as shares of the rows up to 1 or as numbers of rows above; smaller ones are
            subsets of larger ones. Validation rows are thinned with them, test rows stay.
    """

    title: str
    errors_m: Sequence[float] = ()
    errors_deg: Sequence[float] = ()
    train_errors: bool = True
    keep: Sequence[float] = ()

    def __post_init__(self) -> None:
        if not all(float(keep) > 0 for keep in self.keep):
            raise ValueError(f"keep={list(self.keep)}: shares up to 1 or numbers of rows are needed")

    def conditions(self) -> list[Condition]:
        """Return the data as they are, but where rows are thinned, then every change by every amount."""
        placed = ("query", *(("train", "train_known") if self.train_errors else ()))
        amounts = {**dict.fromkeys(placed, self.errors_m), "directions": self.errors_deg, "keep": self.keep}
        changed = [Condition(what, float(amount)) for what, every in amounts.items() for amount in every]
        return changed if self.keep else [Condition(), *changed]


def add_position_errors(data: Measurements, rows: np.ndarray, error_m: float, seed: int) -> Measurements:
    """Add errors N(0, error_m^2) per coordinate to the recorded places of `rows`; measured values stay.

    Rows of one place, heard by several stations, have one error.
    """
    # One error a place, or averages over rows of one place would shrink it.
    _, first, place = np.unique(data.moving[rows], axis=0, return_index=True, return_inverse=True)
    offset = np.random.default_rng(seed).normal(scale=error_m, size=(len(rows), 3))
    return move_rows(data, rows, offset[first][place.reshape(-1)])


def add_direction_errors(
    data: Measurements, error_deg: float, seed: int, *, missing: float = 0.0, false: float = 0.0
) -> Measurements:
    """Disturb directions of arrival as a receiver measures them; all else stays.

    Args:
        data: with directions.
        error_deg: standard deviation about each of two axes across a direction [degrees].
        seed: of the draw.
        missing: share of the directions that are not there.
        false: number of directions from anywhere, as a share of those that are there.

    Raises:
        ValueError: no directions.
    """
    if data.directions is None:
        raise ValueError(f"{data.site.name}: no directions of arrival to disturb; take kind.errors_deg=[]")
    rng, sigma = np.random.default_rng(seed), np.radians(error_deg)
    measured = []
    for true in data.directions:
        ray = true.astype(np.float64)
        aside = rng.normal(scale=sigma, size=ray.shape)
        # Only the part across the ray: to first order a rotation by `aside`, in radians.
        ray = ray + aside - (aside * ray).sum(1, keepdims=True) * ray
        ray = ray[rng.random(len(ray)) >= missing]
        # Directions of a normal vector are uniform on the sphere.
        ray = np.concatenate([ray, rng.normal(size=(rng.binomial(len(ray), false), 3))])
        measured.append((ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32))
    return replace(data, directions=measured)


def thin_fold(fold: Fold, keep: float, seed: int) -> Fold:
    """Return a fold with fewer rows to learn from; smaller ones are subsets of larger ones of the same seed.

    Args:
        fold: its training and validation rows are thinned alike, its test rows stay.
        keep: a share of the rows up to 1; above, a number of rows.
        seed: of the choice.
    """
    every = len(fold.train) + len(fold.val)
    # Never more than there are.
    total = min(round(keep * every if keep <= 1 else keep), every)
    # One validation row at least, where there is one: it decides when to stop.
    validate = min(max(round(total * len(fold.val) / every), 1), len(fold.val))
    # 4 keeps this draw apart from others of the same seed.
    rng = np.random.default_rng([seed, 4])
    train, val = (rng.permutation(rows) for rows in (fold.train, fold.val))
    return Fold(np.sort(train[: max(total - validate, 1)]), np.sort(val[:validate]), fold.test)

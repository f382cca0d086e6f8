"""Variants of one model under conditions of the data: every pair is fitted, scored and timed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from omegaconf import DictConfig, OmegaConf

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.results import average
from gsparc.evaluation.scores import score_methods
from gsparc.models import loading
from gsparc.models.refined_places import move_rows
from gsparc.prediction.timing import ClockSettings
from gsparc.runs.experiment.runner import Job, time_queries
from gsparc.runs.ledger import measurements_hash


@dataclass(frozen=True)
class Condition:
    """One state of the data.

    Attributes:
        what: what was changed: `none`, places of a `query` or in training (`train`; `train_known`:
            by a known error), `directions` of arrival, or how many measurements one may `keep`.
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

    def change_training(
        self, data: Measurements, fold: Fold, seed: int
    ) -> tuple[Measurements, Fold]:
        """Return data and rows of a fold under this condition."""
        if self.what == "keep":
            return data, thin_fold(fold, self.amount, seed)
        if self.what == "directions":
            return add_direction_errors(data, self.amount, seed), fold
        if self.what not in ("train", "train_known"):
            return data, fold
        # Both ends of learning: validation rows are measured with the same instrument.
        moved = add_position_errors(data, fold.learned(), self.amount, seed)
        position_std = (
            np.full(len(data), self.amount) if self.what == "train_known" else moved.position_std
        )
        return replace(moved, position_std=position_std), fold


ROW = (
    "variant",
    "what",
    "amount",
    "effects",
    "rows",
    "figure",
    "value",
    "spread",
    "train_s",
    "train_cpu_s",
    "query_ms",
    "query_p95_ms",
)


@dataclass(frozen=True)
class Round(Condition):
    """One training of a variant.

    Attributes:
        variant: its name.
        round: its number; round r uses the first seed + r.
    """

    variant: str = ""
    round: int = 0

    def __str__(self) -> str:
        changed = "" if self.what == "none" else f", {super().__str__()}"
        return f"{self.variant}{changed}, round {self.round + 1}"


def plan_rounds(
    configs: Mapping[str, DictConfig],
    conditions: Sequence[Condition],
    rounds: int,
    data: Measurements,
    split: Split,
    folder: Path,
) -> list[Job]:
    """List a study's fits: every variant under every condition that changes what is learned from,
    in rounds.

    Args:
        configs: of the variants by name, as composed from conf/train.yaml, with the seed of the
            first round.
        conditions: of the data.
        rounds: trainings of each, in turns; each has another seed, of the draws of errors as well.
        data, split: as they are before any condition.
        folder: of the study.
    """
    learned = dict.fromkeys(each_condition.learned for each_condition in conditions)
    content, jobs = measurements_hash(data), []
    for turn, (variant, config), condition in product(range(rounds), configs.items(), learned):
        job_config = OmegaConf.merge(config, {"seed": config.seed + turn})
        place = folder / variant / str(turn) / str(condition).replace(" ", "-")
        change = partial(condition.change_training, seed=job_config.seed)
        name = Round(condition.what, condition.amount, variant, turn)
        unchanged = condition.what == "none"
        changed = None if unchanged else change
        jobs.append(Job(name, job_config, place, data, split, content, changed))  # type: ignore[arg-type]
    return jobs


def ask_moved(fits: pd.DataFrame, conditions: Sequence[Condition]) -> pd.DataFrame:
    """Return a row per variant, round and condition, of the frame of `run_jobs`.

    Under a `query` condition what was learned from undisturbed rows is asked where these are said
    to be. `rows` are what was learned from, mean over folds;
    `model` is the file of the first fold's.
    """
    rows, (data, split) = [], (fits.job.iloc[0].data, fits.job.iloc[0].split)
    for condition, fit in product(conditions, fits.to_dict("records")):
        if (fit["what"], fit["amount"]) != (condition.learned.what, condition.learned.amount):
            continue
        folds = [condition.change_training(data, fold, fit["seed"])[1] for fold in split.folds]
        row = {**fit, **asdict(condition), "model": fit["run"].checkpoints[0]}
        row["rows"] = float(np.mean([len(fold.learned()) for fold in folds]))
        if condition.what == "query":
            tested = np.concatenate([fold.test for fold in split.folds])
            moved = add_position_errors(data, tested, condition.amount, fit["seed"])
            methods = [loading.load(file)[0] for file in fit["run"].checkpoints]
            row["value"] = pool_figures(score_methods(methods, moved, split), moved, split)[
                fit["figure"]
            ]
        rows.append(row)
    return pd.DataFrame(rows)


def average_rounds(
    fits: pd.DataFrame, conditions: Sequence[Condition], clock: ClockSettings
) -> pd.DataFrame:
    """Put rounds together, and time the models of the last one in turns.

    Args:
        fits: the frame of `run_jobs`.
        conditions: of the study.
        clock: of the queries.

    Returns:
        A row per variant and condition, columns `ROW` (those of `study.csv`).
        `effects` that the variant computes; measurements (`rows`) that it learned from, mean over
        folds. `figure`, `value`: accuracy on the test rows, mean over rounds; `spread`: standard
        deviation. `train_s`, `train_cpu_s`: training of one model by the clock and of the
        processor, median over rounds [s].
        `query_ms`, `query_p95_ms`: single queries, timed in turns with all other rows' [ms].
        NaN where there is no spread.
    """
    every, job = ask_moved(fits, conditions), fits.job.iloc[0]
    every = every.astype(dict.fromkeys(("train_s", "train_cpu_s"), float))
    # The model of the last round is timed: rounds differ in weights, not in size.
    last = {name: (name, "last") for name in ("effects", "rows", "figure", "model")}
    median = {name: (name, "median") for name in ("train_s", "train_cpu_s")}
    by = ["variant", "what", "amount"]
    rows, averages = (
        every.groupby(by, sort=False).agg(**last, **median),
        average(every, by, ["value"]),
    )
    rows = rows.assign(value=averages["mean"].value, spread=averages["std"].value).reset_index()
    order = [list(fits.variant.unique()).index(variant) for variant in rows.variant]
    rows = rows.iloc[np.argsort(order, kind="stable")].reset_index(drop=True)
    # Conditions that share a training share its model and its time: a file is timed once.
    times = time_queries(
        {str(file): file for file in rows.model.unique()}, job.data, job.split, clock
    )
    for name in ("query_ms", "query_p95_ms"):
        rows[name] = [times[str(file)][name] for file in rows.model]
    return rows.assign(effects=rows.effects.str.replace("+", ", "))[list(ROW)]


@dataclass(frozen=True)
class DataChanges:
    """What a study changes about the data, one thing at a time; nothing:
    the variants alone are compared.

    Attributes:
        title: of its table and figure.
        errors_m: standard deviations of each coordinate of places [m].
        errors_deg: of directions of arrival about each of two axes, where receivers measured them
            [degrees].
        train_errors: whether training positions are disturbed, too; else those of queries alone.
        keep: training sets, as shares of the rows up to 1 or as numbers of rows above; smaller ones
            are subsets of larger ones. Validation rows are thinned with them, test rows stay.
    """

    title: str
    errors_m: Sequence[float] = ()
    errors_deg: Sequence[float] = ()
    train_errors: bool = True
    keep: Sequence[float] = ()

    def __post_init__(self) -> None:
        if not all(float(keep) > 0 for keep in self.keep):
            raise ValueError(
                f"keep={list(self.keep)}: shares up to 1 or numbers of rows are needed"
            )

    def conditions(self) -> list[Condition]:
        """Return the data as they are, but where rows are thinned,
        then every change by every amount.
        """
        placed = ("query", *(("train", "train_known") if self.train_errors else ()))
        amounts = {
            **dict.fromkeys(placed, self.errors_m),
            "directions": self.errors_deg,
            "keep": self.keep,
        }
        changed = [
            Condition(key, float(amount))
            for key, each_amount in amounts.items()
            for amount in each_amount
        ]
        return changed if self.keep else [Condition(), *changed]


def add_position_errors(
    data: Measurements, rows: np.ndarray, error_m: float, seed: int
) -> Measurements:
    """Add errors N(0, error_m^2) per coordinate to the recorded places of `rows`;
    measured values stay.

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
        raise ValueError(
            f"{data.site.name}: no directions of arrival to disturb; take kind.errors_deg=[]"
        )
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
    """Return a fold with fewer rows to learn from;
    smaller ones are subsets of larger ones of the same seed.

    Args:
        fold: its training and validation rows are thinned alike, its test rows stay.
        keep: a share of the rows up to 1; above, a number of rows.
        seed: of the choice.
    """
    every = len(fold.learned())
    # Never more than there are.
    total = min(round(keep * every if keep <= 1 else keep), every)
    # One validation row at least, where there is one: it decides when to stop.
    validate = min(max(round(total * len(fold.val) / every), 1), len(fold.val))
    # 4 keeps this draw apart from others of the same seed.
    rng = np.random.default_rng([seed, 4])
    train, val = (rng.permutation(rows) for rows in (fold.train, fold.val))
    return Fold(np.sort(train[: max(total - validate, 1)]), np.sort(val[:validate]), fold.test)

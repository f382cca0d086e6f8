"""Variants of one model under conditions of the data: every pair is fitted, scored and timed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.experiment.fit import Outcome, fit_folds, in_folders
from gsparc.evaluation.metric_formats import DECIDING
from gsparc.models.method import Method
from gsparc.models.refined_places import displaced as elsewhere
from gsparc.prediction.timing import ClockSettings, cycling, interleaved, percentiles, queries
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

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
    def changes_training(self) -> bool:
        """Whether it changes what is learned from."""
        return self.what not in ("none", "query")

    def learned_from(self, data: Measurements, fold: Fold, seed: int) -> tuple[Measurements, Fold]:
        """Data and rows of a fold under this condition."""
        if self.what == "keep":
            return data, thinned(fold, self.amount, seed)
        if self.what == "directions":
            return turned(data, self.amount, seed), fold
        if self.what not in ("train", "train_known"):
            return data, fold
        moved = displaced(data, np.concatenate([fold.train, fold.val]), self.amount, seed)
        known = np.full(len(data), self.amount) if self.what == "train_known" else moved.position_std
        return replace(moved, position_std=known), fold

    def tested_on(self, data: Measurements, split: Split, seed: int) -> Measurements:
        """Data whose test rows are asked about."""
        return displaced(data, np.concatenate([fold.test for fold in split.folds]), self.amount, seed)


ROW = (
    "variant", "what", "amount", "effects", "rows", "figure", "value", "spread", "train_s", "train_cpu_s",
    "train_ratio", "query_ms", "query_p95_ms", "query_ratio",
)  # fmt: skip
NAMES = ("variant", "what", "amount", "figure", "value", "spread")


def facts_of(rows: pd.DataFrame) -> dict[str, Any]:
    """`study/<variant>[/<what>/<amount>]/*`: accuracy under its own name, seconds, milliseconds."""
    facts: dict[str, Any] = {}
    for row in rows.to_dict("records"):
        stem = f"study/{row['variant']}" + (
            "" if row["what"] == "none" else f"/{row['what']}/{row['amount']:g}"
        )
        own = {row["figure"]: row["value"], f"{row['figure']}_spread": row["spread"]}
        own |= {name: value for name, value in row.items() if name not in NAMES}
        facts |= {f"{stem}/{name}": value for name, value in own.items() if pd.notna(value)}
    return facts


@dataclass(frozen=True)
class Study:
    """What is compared.

    Attributes:
        variants: what makes an unfitted method, by name, in the order of the table.
        conditions: each variant is fitted once per condition that changes what is learned from.
        base: name of the variant that times are compared with; None: no ratios.
        rounds: trainings of each, in turns; round r uses seed + r.
        seed: of the first round.
        clock: of the queries.
    """

    variants: Mapping[str, Callable[[], Method]]
    conditions: Sequence[Condition] = (Condition(),)
    base: str | None = None
    rounds: int = 1
    seed: int = 0
    clock: ClockSettings = field(default_factory=ClockSettings)

    def __post_init__(self) -> None:
        if self.base is not None and self.base not in self.variants:
            raise ValueError(f"base={self.base}: no such variant; there are {', '.join(self.variants)}")

    def run(self, data: Measurements, split: Split, context: FitContext) -> pd.DataFrame:
        """Fit, score and time everything; a variant that the data do not allow is left out.

        Args:
            data, split: as they are before any condition.
            context: of every fit, but for its folder and seed.

        Returns:
            A row per variant and condition, columns `ROW` (those of `study.csv`).
            `effects` that the variant computes; measurements (`rows`) that it learned from, mean over folds.
            `figure`, `value`: accuracy on the test rows, mean over rounds; `spread`: standard deviation.
            `train_s`, `train_cpu_s`: training of one model by the clock and of the processor, median over
            rounds [s]; `train_ratio`: median of `train_s` to the base variant's of the same round.
            `query_ms`, `query_p95_ms`: single queries, timed in turns with all other rows' [ms];
            `query_ratio`: to the base variant's. NaN where there is no spread or ratio.

        Raises:
            ValueError: the base variant, or every variant, cannot be trained here.
        """
        outcomes: dict[tuple[str, Condition], list[Outcome]] = {}
        allowed = list(self.variants)
        for turn in range(self.rounds):
            for variant in list(allowed):
                try:
                    by_condition = self._outcomes(variant, data, split, context, turn)
                except ValueError as refused:
                    if variant == self.base or REFUSED not in str(refused) or len(allowed) == 1:
                        raise
                    log.info("%s is left out: %s", variant, refused)
                    allowed.remove(variant)
                    continue
                for condition, outcome in by_condition.items():
                    outcomes.setdefault((variant, condition), []).append(outcome)
        return self._rows(outcomes, data, split)

    def _outcomes(
        self, variant: str, data: Measurements, split: Split, context: FitContext, turn: int
    ) -> dict[Condition, Outcome]:
        """One training per condition that changes what is learned from."""
        by_condition: dict[Condition, Outcome] = {}
        seed, plain = self.seed + turn, None
        for condition in self.conditions:
            outcome = plain
            if outcome is None or condition.changes_training:
                folder = context.run_dir / variant / str(condition).replace(" ", "-") / str(turn)
                contexts = in_folders(replace(context, run_dir=folder, seed=seed), split)
                learned_from = partial(condition.learned_from, seed=seed)
                fits = fit_folds(self.variants[variant], data, split, contexts, learned=learned_from)
                outcome = fits.scored_on(data, split)
                plain = plain if condition.changes_training else outcome
            if condition.what == "query":
                outcome = outcome.scored_on(condition.tested_on(data, split, seed), split)
            by_condition[condition] = outcome
            figure = DECIDING[data.site.scored]
            log.info(
                "%s, %s, round %d of %d: %s %.4g after %.3g s of training",
                variant, condition, turn + 1, self.rounds, figure, _value(outcome, figure),
                sum(outcome.train_s),
            )  # fmt: skip
        return by_condition

    def _rows(
        self, outcomes: Mapping[tuple[str, Condition], list[Outcome]], data: Measurements, split: Split
    ) -> pd.DataFrame:
        figure = DECIDING[data.site.scored]
        # A method that was only asked elsewhere is the same on the clock: it is timed once.
        methods = {str(id(o[-1].methods[0])): o[-1].methods[0] for o in outcomes.values()}
        times = interleaved(cycling(methods, queries(data, split.folds[0].test)), self.clock)
        query = {key: percentiles(times[str(id(o[-1].methods[0]))]) for key, o in outcomes.items()}
        train = {key: np.array([np.mean(one.train_s) for one in o]) for key, o in outcomes.items()}
        rows = []
        for key, rounds in outcomes.items():
            variant, condition = key
            values = np.array([_value(one, figure) for one in rounds])
            base = (self.base or "", condition)
            compared = base in outcomes
            folds = [condition.learned_from(data, fold, self.seed)[1] for fold in split.folds]
            rows.append((
                variant, condition.what, condition.amount, str(rounds[-1].methods[0].effects or "none"),
                float(np.mean([len(fold.train) + len(fold.val) for fold in folds])), figure, values.mean(),
                values.std(ddof=1) if len(values) > 1 else np.nan, np.median(train[key]),
                np.median([np.mean(one.train_cpu_s) for one in rounds]),
                np.median(train[key] / train[base]) if compared else np.nan, *query[key],
                query[key][0] / query[base][0] if compared else np.nan,
            ))  # fmt: skip
        return pd.DataFrame(rows, columns=ROW)


def _value(outcome: Outcome, figure: str) -> float:
    value = outcome.figures[figure]
    if value is None:
        raise ValueError(f"{figure} is not defined on these test rows")
    return value


@dataclass(frozen=True)
class Effects:
    """What each effect costs, and what it gains: the data stay as they are."""

    title: ClassVar[str] = "what effects cost and gain"

    def conditions(self) -> list[Condition]:
        """The data as they are."""
        return [Condition()]


@dataclass(frozen=True)
class Positions:
    """What errors of positions and of directions of arrival cost.

    Attributes:
        errors_m: standard deviations of each coordinate [m].
        errors_deg: of directions of arrival about each of two axes, where receivers measured them [degrees].
        train_errors: whether training positions are disturbed, too; else those of queries alone.
    """

    title: ClassVar[str] = "accuracy against errors of positions and directions"
    errors_m: Sequence[float] = ()
    errors_deg: Sequence[float] = ()
    train_errors: bool = True

    def conditions(self) -> list[Condition]:
        """No error, then of a `query`, in training (`train`, or `train_known` in size), of `directions`."""
        errors, degrees = list(map(float, self.errors_m)), list(map(float, self.errors_deg))
        return [
            Condition(),
            *(
                Condition(what, error)
                for what in ("query", *(("train", "train_known") if self.train_errors else ()))
                for error in errors
            ),
            *(Condition("directions", error) for error in degrees),
        ]


@dataclass(frozen=True)
class Measured:
    """Accuracy against the number of measurements.

    Attributes:
        keep: training sets, as shares of the rows up to 1 or as numbers of rows above; smaller ones are
            subsets of larger ones. Validation rows are thinned with them, test rows stay.
    """

    title: ClassVar[str] = "accuracy against the number of measurements"
    keep: Sequence[float] = (1.0,)

    def __post_init__(self) -> None:
        if not self.keep or not all(float(keep) > 0 for keep in self.keep):
            raise ValueError(f"keep={list(self.keep)}: shares up to 1 or numbers of rows are needed")

    def conditions(self) -> list[Condition]:
        """A condition per training set, called `keep`."""
        return [Condition("keep", float(keep)) for keep in self.keep]


def displaced(data: Measurements, rows: np.ndarray, error_m: float, seed: int) -> Measurements:
    """The moving end of `rows` believed elsewhere by N(0, error_m^2) per coordinate; all else the same.

    Rows of one place, heard by several stations, are believed to be at one place.
    """
    _, first, place = np.unique(data.moving[rows], axis=0, return_index=True, return_inverse=True)
    offset = np.random.default_rng(seed).normal(scale=error_m, size=(len(rows), 3))
    return elsewhere(data, rows, offset[first][place.reshape(-1)])


def turned(
    data: Measurements, error_deg: float, seed: int, *, missing: float = 0.0, false: float = 0.0
) -> Measurements:
    """Directions of arrival as a receiver measures them; all else the same.

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
        ray = ray + aside - (aside * ray).sum(1, keepdims=True) * ray
        ray = ray[rng.random(len(ray)) >= missing]
        ray = np.concatenate([ray, rng.normal(size=(rng.binomial(len(ray), false), 3))])
        measured.append((ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32))
    return replace(data, directions=measured)


def thinned(fold: Fold, keep: float, seed: int) -> Fold:
    """A fold with fewer rows to learn from; smaller ones are subsets of larger ones of the same seed.

    Args:
        fold: its training and validation rows are thinned alike, its test rows stay.
        keep: a share of the rows up to 1; above, a number of rows.
        seed: of the choice.
    """
    every = len(fold.train) + len(fold.val)
    total = min(round(keep * every if keep <= 1 else keep), every)
    validate = min(max(round(total * len(fold.val) / every), 1), len(fold.val))
    rng = np.random.default_rng([seed, 4])
    train, val = (rng.permutation(rows) for rows in (fold.train, fold.val))
    return Fold(np.sort(train[: max(total - validate, 1)]), np.sort(val[:validate]), fold.test)

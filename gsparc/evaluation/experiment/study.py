"""Variants of one model under conditions of the data: every pair is fitted, scored and timed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.experiment.fit import Outcome, fit_and_score, in_folders
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
        what: what was changed; `none`: nothing.
        amount: by how much, in the units of `what`.
        learned: data and rows of a fold that are learned from, by a seed; None: as they are.
        tested: data that are tested on, by a seed; None: as they are.
    """

    what: str = "none"
    amount: float = 0.0
    learned: Callable[[Measurements, Fold, int], tuple[Measurements, Fold]] | None = None
    tested: Callable[[Measurements, Split, int], Measurements] | None = None

    def __str__(self) -> str:
        return self.what if self.what == "none" else f"{self.what} {self.amount:g}"

    def learned_from(self, data: Measurements, fold: Fold, seed: int) -> tuple[Measurements, Fold]:
        """Data and rows of a fold under this condition."""
        return (data, fold) if self.learned is None else self.learned(data, fold, seed)


@dataclass(frozen=True)
class Row:
    """A variant under a condition.

    Attributes:
        variant, what, amount: names and amount, see `Study` and `Condition`.
        effects: the propagation effects it computes.
        rows: measurements it learned from, mean over folds.
        figure: name of the accuracy.
        value: the accuracy on the test rows, mean over rounds.
        spread: its standard deviation over rounds; None for one round.
        train_s, train_cpu_s: training of one model by the clock and of the processor, median over rounds [s].
        train_ratio: median over rounds of `train_s` to the base variant's of the same round.
        query_ms, query_p95_ms: single queries, timed in turns with all other rows' [ms].
        query_ratio: to the base variant's.
    """

    variant: str
    what: str
    amount: float
    effects: str
    rows: float
    figure: str
    value: float
    spread: float | None
    train_s: float
    train_cpu_s: float
    train_ratio: float | None
    query_ms: float
    query_p95_ms: float
    query_ratio: float | None

    def facts(self) -> dict[str, Any]:
        """`study/<variant>[/<what>/<amount>]/*`: accuracy under its own name, seconds, milliseconds."""
        stem = f"study/{self.variant}" + ("" if self.what == "none" else f"/{self.what}/{self.amount:g}")
        named = {self.figure: self.value, f"{self.figure}_spread": self.spread}
        rest = {k: v for k, v in asdict(self).items() if k not in NAMES}
        return {f"{stem}/{key}": value for key, value in {**named, **rest}.items() if value is not None}


NAMES = ("variant", "what", "amount", "figure", "value", "spread")


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

    def run(self, data: Measurements, split: Split, context: FitContext) -> list[Row]:
        """Fit, score and time everything; a variant that the data do not allow is left out.

        Args:
            data, split: as they are before any condition.
            context: of every fit, but for its folder and seed.

        Raises:
            ValueError: the base variant, or every variant, cannot be trained here.
        """
        outcomes: dict[tuple[str, Condition], list[Outcome]] = {}
        allowed = list(self.variants)
        for turn in range(self.rounds):
            for variant in list(allowed):
                try:
                    found = self._outcomes(variant, data, split, context, turn)
                except ValueError as refused:
                    if variant == self.base or REFUSED not in str(refused) or len(allowed) == 1:
                        raise
                    log.info("%s is left out: %s", variant, refused)
                    allowed.remove(variant)
                    continue
                for condition, outcome in found.items():
                    outcomes.setdefault((variant, condition), []).append(outcome)
        return self._rows(outcomes, data, split)

    def _outcomes(
        self, variant: str, data: Measurements, split: Split, context: FitContext, turn: int
    ) -> dict[Condition, Outcome]:
        """One training per condition that changes what is learned from."""
        found: dict[Condition, Outcome] = {}
        seed, plain = self.seed + turn, None
        for condition in self.conditions:
            outcome, learned = plain, condition.learned
            if outcome is None or learned is not None:
                folder = context.run_dir / variant / str(condition).replace(" ", "-") / str(turn)
                settings = in_folders(replace(context, run_dir=folder, seed=seed))
                learned_from = partial(condition.learned_from, seed=seed)
                make = self.variants[variant]
                outcome = fit_and_score(make, data, split, settings, learned=learned_from)
                plain = outcome if learned is None else plain
            if condition.tested is not None:
                outcome = outcome.scored_on(condition.tested(data, split, seed), split)
            found[condition] = outcome
            figure = DECIDING[data.site.kind]
            log.info(
                "%s, %s, round %d of %d: %s %.4g after %.3g s of training",
                variant, condition, turn + 1, self.rounds, figure, _value(outcome, figure),
                sum(outcome.train_s),
            )  # fmt: skip
        return found

    def _rows(
        self, outcomes: Mapping[tuple[str, Condition], list[Outcome]], data: Measurements, split: Split
    ) -> list[Row]:
        figure = DECIDING[data.site.kind]
        # A method that was only asked elsewhere is the same on the clock: it is timed once.
        methods = {str(id(o[-1].methods[0])): o[-1].methods[0] for o in outcomes.values()}
        times = interleaved(cycling(methods, queries(data, split.folds[0].test)), self.clock)
        asked = {name: percentiles(ms) for name, ms in times.items()}
        rows = []
        for (variant, condition), found in outcomes.items():
            values = [_value(one, figure) for one in found]
            seconds = np.array([np.mean(one.train_s) for one in found])
            p50, p95 = asked[str(id(found[-1].methods[0]))]
            train_ratio = query_ratio = None
            base = outcomes.get((self.base or "", condition))
            if base is not None:
                train_ratio = float(np.median(seconds / np.array([np.mean(one.train_s) for one in base])))
                query_ratio = p50 / asked[str(id(base[-1].methods[0]))][0]
            folds = [condition.learned_from(data, fold, self.seed)[1] for fold in split.folds]
            rows.append(
                Row(
                    variant, condition.what, condition.amount,
                    str(found[-1].methods[0].effects or "none"),
                    float(np.mean([len(fold.train) + len(fold.val) for fold in folds])),
                    figure, float(np.mean(values)),
                    float(np.std(values, ddof=1)) if len(values) > 1 else None,
                    float(np.median(seconds)),
                    float(np.median([np.mean(one.train_cpu_s) for one in found])),
                    train_ratio, p50, p95, query_ratio,
                )
            )  # fmt: skip
        return rows


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
            *(Condition("query", error, tested=partial(_asked_elsewhere, error)) for error in errors),
            *(
                Condition(name, error, learned=partial(_learned_elsewhere, error, known))
                for name, known in (("train", False), ("train_known", True))
                for error in errors
                if self.train_errors
            ),
            *(Condition("directions", error, learned=partial(_turned, error)) for error in degrees),
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
        return [Condition("keep", float(keep), learned=partial(_thinned, float(keep))) for keep in self.keep]


def _asked_elsewhere(error_m: float, data: Measurements, split: Split, seed: int) -> Measurements:
    return displaced(data, np.concatenate([fold.test for fold in split.folds]), error_m, seed)


def _learned_elsewhere(
    error_m: float, known: bool, data: Measurements, fold: Fold, seed: int
) -> tuple[Measurements, Fold]:
    moved = displaced(data, np.concatenate([fold.train, fold.val]), error_m, seed)
    return (replace(moved, position_std=np.full(len(data), error_m)) if known else moved), fold


def _turned(error_deg: float, data: Measurements, fold: Fold, seed: int) -> tuple[Measurements, Fold]:
    return turned(data, error_deg, seed), fold


def _thinned(keep: float, data: Measurements, fold: Fold, seed: int) -> tuple[Measurements, Fold]:
    return data, thinned(fold, keep, seed)


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

"""Kinds of studies (`conf/kind`): what is done to the data before every variant is fitted and scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.evaluation.experiment.study import Condition


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
        """No error, then errors of positions in a `query`, in training (`train`), and of `directions`."""
        errors, degrees = list(map(float, self.errors_m)), list(map(float, self.errors_deg))
        return [
            Condition(),
            *(_query(error) for error in errors),
            *(_train(error) for error in errors if self.train_errors),
            *(_directions(error) for error in degrees),
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
        return [_keep(float(keep)) for keep in self.keep]


def _query(error_m: float) -> Condition:
    return Condition(
        "query", error_m,
        tested=lambda data, split, seed: displaced(
            data, np.concatenate([fold.test for fold in split.folds]), error_m, seed
        ),
    )  # fmt: skip


def _train(error_m: float) -> Condition:
    return Condition(
        "train", error_m,
        learned=lambda data, fold, seed: (
            displaced(data, np.concatenate([fold.train, fold.val]), error_m, seed), fold
        ),
    )  # fmt: skip


def _directions(error_deg: float) -> Condition:
    return Condition(
        "directions", error_deg, learned=lambda data, fold, seed: (turned(data, error_deg, seed), fold)
    )


def _keep(keep: float) -> Condition:
    return Condition("keep", keep, learned=lambda data, fold, seed: (data, thinned(fold, keep, seed)))


def displaced(data: Measurements, rows: np.ndarray, error_m: float, seed: int) -> Measurements:
    """The moving end of `rows` believed elsewhere by N(0, error_m^2) per coordinate; all else the same."""
    offset = np.random.default_rng(seed).normal(scale=error_m, size=(len(rows), 3))
    name = "tx" if data.site.moving_end == "tx" else "rx_position"
    moved = getattr(data, name).copy()
    moved[rows] += offset
    return replace(data, **{name: moved})


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

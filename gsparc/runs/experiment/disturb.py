"""What is wrong with measurements, or missing, when a method learns from them and is asked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsparc.base.limits import POSITIVE, Checked, number, setting, switch
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.models.refined_places import move_rows


@dataclass(frozen=True)
class Disturbance(Checked):
    """Errors that are added to measurements; figures are of the rows as they were measured.

    Attributes:
        queries_m: standard deviation of each coordinate of places where test rows are asked [m].
        train_m: the same of rows that are learned from, validation rows as well [m].
        known: whether these rows state it (`position_std`).
        directions_deg: of directions of arrival about each of two axes, where receivers measured
            them [degrees].
        keep: share of the rows that are learned from, above 1 their number; test rows stay.
        seed: of the draws; smaller sets of rows are subsets of larger ones.
    """

    queries_m: float = setting(0.0, number(0))
    train_m: float = setting(0.0, number(0))
    known: bool = setting(False, switch())
    directions_deg: float = setting(0.0, number(0))
    keep: float = setting(1.0, POSITIVE)
    seed: int = 0

    def learned(self, data: Measurements, split: Split) -> tuple[Measurements, Split] | None:
        """Return what is learned from; None where nothing of it is wrong."""
        if self.keep == 1 and not (self.directions_deg or self.train_m):
            return None
        if self.directions_deg:
            data = add_direction_errors(data, self.directions_deg, self.seed)
        if self.train_m:
            data = add_position_errors(data, np.arange(len(data)), self.train_m, self.seed)
        if self.train_m and self.known:
            data = replace(data, position_std=np.full(len(data), self.train_m))
        folds = (thin_fold(fold, self.keep, self.seed) for fold in split.folds)
        return data, replace(split, folds=tuple(folds))

    def asked(self, data: Measurements, split: Split) -> Measurements:
        """Return the measurements with errors where test rows are asked."""
        tested = np.concatenate([fold.test for fold in split.folds])
        if not self.queries_m:
            return data
        return add_position_errors(data, tested, self.queries_m, self.seed)


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
            f"{data.site.name}: no directions of arrival; leave out disturb.directions_deg"
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
    total_rows = len(fold.learned())
    # Never more than there are.
    total = min(round(keep * total_rows if keep <= 1 else keep), total_rows)
    # One validation row at least, where there is one: it decides when to stop.
    validate = min(max(round(total * len(fold.val) / total_rows), 1), len(fold.val))
    # 4 keeps this draw apart from others of the same seed.
    rng = np.random.default_rng([seed, 4])
    train, val = (rng.permutation(rows) for rows in (fold.train, fold.val))
    return Fold(np.sort(train[: max(total - validate, 1)]), np.sort(val[:validate]), fold.test)

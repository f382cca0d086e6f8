"""Training, validation and test rows: pure functions of positions and settings,
stored with a hash.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsparc.base.errors import DataError
from gsparc.data.held_out import block_rows, corner_fold, grouped_folds, last_rows
from gsparc.data.schema import TrainTest
from gsparc.data.spacing import thin_rows
from gsparc.data.split_settings import WHOLE, FileSettings, LeaveOut, SplitSettings
from gsparc.processes.few_rows import sample_row_numbers

LEAST_ROWS = 4  # fewer training rows than this teach nothing


@dataclass(frozen=True)
class Fold:
    """Disjoint row indices; `val` is for choosing and calibrating, never for reporting.

    Attributes:
        train, val, test: (n,) int64, sorted.
    """

    train: np.ndarray
    val: np.ndarray
    test: np.ndarray

    def learned(self, eval_on: str = "test") -> np.ndarray:
        """Return rows that are learned from: all but test rows,
        and without `val` where `val` is scored.
        """
        return self.train if eval_on == "val" else np.concatenate([self.train, self.val])

    @classmethod
    def of_all(cls, rows: np.ndarray) -> Fold:
        """Return rows that are all learned from: none is validated or tested on."""
        return cls(rows, rows[:0], rows[:0])

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> Fold:
        """Return the three parts changed alike."""
        return Fold(*map(change, (self.train, self.val, self.test)))


@dataclass(frozen=True)
class Split:
    """One fold, or several whose test results are pooled.

    >>> places = np.random.default_rng(0).uniform(0, 9, (100, 3))
    >>> first, other = (make_split(places, SplitSettings(seed=seed)) for seed in (0, 1))
    >>> first.sha256 == other.sha256
    False

    Attributes:
        name: one of `NAMES`, or a file's.
        folds: one or more folds.
        of_release: whether the release named the test rows.
    """

    name: str
    folds: tuple[Fold, ...]
    of_release: bool = False

    @cached_property
    def sha256(self) -> str:
        """Hash of all indices."""
        return hash_indices(self.folds)

    @property
    def title(self) -> str:
        """Return its name, and that no seed draws the test rows where the release names them."""
        asked = " (all rows of the file are asked)" if self.name == "whole" else ""
        named = " (test rows named by its files)" if self.of_release else ""
        return self.name + asked + named

    def check(self) -> None:
        """Refuse folds that teach nothing, or test nothing (DataError)."""
        for i, fold in enumerate(self.folds):
            if len(fold.train) < LEAST_ROWS or not (len(fold.test) or self.name == "none"):
                raise DataError(
                    f"split={self.name}: fold {i} has {len(fold.train)} training and "
                    f"{len(fold.test)} "
                    f"test rows; at least {LEAST_ROWS} and 1 are needed"
                )


AnySplit = SplitSettings | FileSettings


def make_split(
    positions: np.ndarray,
    settings: SplitSettings,
    release_split: TrainTest | None = None,
    outliers: np.ndarray | None = None,
    place: np.ndarray | None = None,
    station: np.ndarray | None = None,
    order: np.ndarray | None = None,
) -> Split:
    """Split rows by the positions of the moving end; what is held out is so for all stations.

    >>> places = np.random.default_rng(0).uniform(0, 9, (100, 3))
    >>> fold = make_split(places, SplitSettings("random")).folds[0]
    >>> len(fold.train), len(fold.val), len(fold.test)
    (72, 8, 20)
    >>> [len(fold.test) for fold in make_split(places, SplitSettings("grouped", folds=4)).folds]
    [25, 25, 25, 25]

    Args:
        positions: (S, 3) [m] of the moving end, or (S, 6) of both; squares are counted from zero.
        settings: how.
        release_split: (train, test) rows that the release names; used by `random` only.
        outliers: (n,) rows that a name in `leave_out` means.
        place: (S,) int64; rows of one place stay together. None where every row is one.
        station: (S,) int64, of which station, carrier or run a row is; needed by the splits of
            these names.
        order: (S,) rows as `none` draws those that validate, or as `later` rows were taken; None:
            by their numbers.

    Raises:
        DataError: a fold would have no training, or no test rows; a row to leave out that there is
            not.
    """
    rows, rule = len(positions), settings.leave_out
    absent = (
        np.zeros(0, np.int64) if isinstance(rule, int) else rows_to_leave_out(rule, outliers, rows)
    )
    rows_left = np.setdiff1d(np.arange(rows), absent)
    # Files of the release are its published split; `redraw` draws another one instead.
    named = (
        None
        if settings.name != "random" or release_split is None or settings.redraw
        else release_split
    )
    # `first`: the row that stands for each place; `which`: the place of each row.
    first = which = np.arange(len(rows_left))
    if settings.name in WHOLE:
        unit = None if station is None else station[rows_left]
        local_folds = _whole(unit, positions[rows_left], settings)
    else:
        if named is not None:
            # Rows were renumbered when some were left out:
            # from numbers of the file to those that remain.
            train, test = (
                np.searchsorted(rows_left, np.intersect1d(part, rows_left)) for part in named
            )
            named = train, test
        elif place is not None and settings.name != "later":
            # One row stands for each place: splits are made of places,
            # so that no visit is on both sides.
            _, first, which = np.unique(place[rows_left], return_index=True, return_inverse=True)
        where = positions[rows_left][first]
        queue = (
            np.arange(len(first))
            if order is None
            else np.argsort(order[rows_left][first], kind="stable")
        )
        pairs = [named] if named is not None else _pairs(where, queue, settings)
        local_folds = tuple(_finish(i, *pair, where, settings) for i, pair in enumerate(pairs))
    folds = tuple(
        fold.map(lambda part: rows_left[np.isin(which.reshape(-1), part)]) for fold in local_folds
    )
    return Split(settings.name, folds, named is not None)


def _pairs(positions: np.ndarray, taken: np.ndarray, settings: SplitSettings) -> list[TrainTest]:
    """(training, test) rows of each fold, before thinning and validation; `taken` (n,)
    are rows in order.
    """
    rows, rng = np.arange(len(positions)), np.random.default_rng(settings.seed)
    match settings.name:
        case "random":
            return [last_rows(rng.permutation(rows), settings.test_fraction)]
        case "sparse":
            learned = settings.train_fraction
            share = learned if learned < 1 else learned / len(rows)
            if share >= 1:
                raise DataError(f"split.train_fraction={learned:g}: there are {len(rows)} rows")
            return [last_rows(rng.permutation(rows), 1 - share)]
        case "later":
            return [last_rows(taken, settings.test_fraction)]
        case "none":
            return [(taken, taken[:0])]
        case "grouped":
            return grouped_folds(positions, settings)
        case "corner":
            return [corner_fold(positions, settings)]
        case "blocks":
            test = block_rows(positions, rows, settings, settings.share, [settings.seed])
            return [(np.setdiff1d(rows, test), test)]
    raise ValueError(f"split={settings.name}: no such way to split by places")


def rows_to_leave_out(leave_out: LeaveOut, outliers: np.ndarray | None, rows: int) -> np.ndarray:
    """Return the rows (n,) int64 of `rows` that `leave_out` names, `outliers` (n,)
    being those of a name.

    >>> rows_to_leave_out([3, 17], None, rows=20)
    array([ 3, 17])

    Raises:
        DataError: there is no such row.
    """
    named = outliers if isinstance(leave_out, str) else leave_out
    absent = [int(row) for row in (() if named is None else named)]
    if max(absent, default=-1) >= rows:
        raise DataError(f"split.leave_out: row {max(absent)} of rows 0 to {rows - 1}")
    return np.array(absent, dtype=np.int64)


def remove_rows(split: Split, absent: np.ndarray) -> Split:
    """Return the same folds without the rows `absent` (n,)."""
    return Split(
        split.name, tuple(fold.map(lambda part: np.setdiff1d(part, absent)) for fold in split.folds)
    )


def hash_indices(folds: tuple[Fold, ...], parts: Sequence[str] = ("train", "val", "test")) -> str:
    """Return the SHA-256 of all indices of all folds, or of some `parts` of each."""
    digest = hashlib.sha256()
    for fold in folds:
        for part in (getattr(fold, name) for name in parts):
            # The length first: moving a row from one part to the next changes the hash.
            digest.update(len(part).to_bytes(8, "little") + part.astype("<i8").tobytes())
    return digest.hexdigest()


def _whole(
    unit: np.ndarray | None, positions: np.ndarray, settings: SplitSettings
) -> tuple[Fold, ...]:
    """Folds that each hold out a station, or one that holds out `leave_out` of them,
    or a share of the runs.

    Args:
        unit: (S,) int64 number of each row's station, carrier or run.
        positions: (S, 3) [m] of the other end.
    """
    name = settings.name
    if unit is None:
        raise DataError(
            f"split={name}: these measurements have one {name[:-1]}; take split=random or blocks"
        )
    unit = np.unique(unit, return_inverse=True)[1].reshape(-1)
    count = int(unit.max()) + 1
    together = settings.held_out_count(count)
    least = 1 if name == "runs" else 2
    if count - max(together, 1) < least:
        remain = "two at least must remain" if least == 2 else "one must remain"
        raise DataError(f"split={name}: {count} {name}; {remain} to learn from and to choose on")
    draw = np.random.default_rng(settings.seed).permutation(count)
    test_units = [draw[:together]] if together else [np.array([t]) for t in range(count)]
    rows = np.arange(len(unit))
    is_known = is_new = np.ones(len(unit), bool)
    if settings.end == "both":
        squares = block_rows(positions, rows, settings, settings.share, [settings.seed])
        is_new = np.isin(rows, squares)
        is_known = ~is_new
    folds = []
    for fold, test in enumerate(test_units):
        rest = np.setdiff1d(np.arange(count), test)
        rest = np.random.default_rng([settings.seed, fold, 2]).permutation(rest)
        # At least one to choose on, and one to learn from.
        chosen = rest[: min(max(round(settings.val_fraction * len(rest)), 1), len(rest) - 1)]
        learned = (np.isin(unit, part) & is_known for part in (np.setdiff1d(rest, chosen), chosen))
        folds.append(Fold(*map(np.flatnonzero, (*learned, np.isin(unit, test) & is_new))))
    return tuple(folds)


def _finish(
    fold: int, train: np.ndarray, test: np.ndarray, positions: np.ndarray, s: SplitSettings
) -> Fold:
    """Thin the training rows, then set some of them aside for validation."""
    if s.spacing_m is not None:
        train = thin_rows(positions, train, s.spacing_m, [s.seed, fold, 3])
    # A stream of draws for each purpose (1 thinning, 2 validation, 3 spacing):
    # none shifts another's.
    rng = np.random.default_rng([s.seed, fold, 1])
    keep = len(train) if s.train_count is None else s.train_count
    keep = max(min(keep, round(s.thin * len(train))), 1) if len(train) else 0
    # A prefix of one permutation: smaller training sets are subsets of larger ones.
    train = train[sample_row_numbers(len(train), keep, rng)]
    if len(train) == 0 or (len(test) == 0 and s.name != "none"):
        raise DataError(
            f"split={s.name}: fold {fold} has {len(train)} training and {len(test)} test rows of "
            f"{len(positions)}; measure more, or change split.buffer_m or the shares"
        )
    least = int(s.val_fraction > 0 and len(train) > 1)
    count = max(min(round(s.val_fraction * len(train)), len(train) - 1), least)
    rng = np.random.default_rng([s.seed, fold, 2])
    if s.name == "grouped":
        # A stretch in one piece: single rows between training rows of a path would be too easy.
        start = int(rng.integers(len(train) - count + 1))
        chosen = np.arange(start, start + count)
    elif s.name == "blocks" and count:
        # Validation as hard as the test: whole squares as well.
        chosen = np.searchsorted(
            train, block_rows(positions, train, s, s.val_fraction, [s.seed, fold, 2])
        )
    else:
        chosen = rng.permutation(len(train))[:count]
    val = train[chosen]
    return Fold(np.sort(np.setdiff1d(train, val)), np.sort(val), np.sort(test).astype(np.int64))

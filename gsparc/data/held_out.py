"""Which rows a fold tests on: stretches of a path, squares of floor, a corner."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsparc.base.errors import DataError
from gsparc.data.schema import TrainTest
from gsparc.data.spacing import number_squares, path_order, rows_far_from, tenth_of_extent

if TYPE_CHECKING:
    from gsparc.data.split_settings import SplitSettings


def last_rows(order: np.ndarray, test_share: float) -> TrainTest:
    """The last of ordered rows as test rows; rounding leaves one row on either side."""
    train_count = len(order) - min(max(round(test_share * len(order)), 1), max(len(order) - 1, 0))
    return np.sort(order[:train_count]), np.sort(order[train_count:])


def grouped_folds(positions: np.ndarray, settings: SplitSettings) -> list[TrainTest]:
    """Each fold tests on whole stretches of the path, training rows near them dropped."""
    order = path_order(positions)
    if len(order) < 2 * settings.folds * settings.stretches_per_fold:
        raise DataError(
            f"split=grouped: {len(order)} rows are too few for {settings.folds} folds of "
            f"{settings.stretches_per_fold} stretches; lower split.folds or take split=random"
        )
    stretches = np.array_split(order, settings.folds * settings.stretches_per_fold)
    pairs = []
    for fold in range(settings.folds):
        # Every folds-th stretch: one fold's stretches lie all over the site.
        test = np.concatenate(stretches[fold :: settings.folds])
        # Path order is kept here: the validation stretch is cut from it.
        rest = order[~np.isin(order, test)]
        pairs.append((rows_far_from(positions, rest, test, settings.buffer_m), np.sort(test)))
    return pairs


def block_rows(
    positions: np.ndarray, rows: np.ndarray, settings: SplitSettings, share: float, seed: list[int]
) -> np.ndarray:
    """Those of `rows` in whole squares of floor,
    drawn until they are a `share` of `rows` at least.
    """
    floor = positions[:, :2]
    side = settings.side_m or tenth_of_extent(floor)
    if not tenth_of_extent(floor) > 0:
        raise DataError(
            "split=blocks: all positions are one above the other, there are no squares of floor"
        )
    square = number_squares(floor[rows], side)
    order = np.random.default_rng(seed).permutation(square.max() + 1)
    # Whole squares are added until the share is reached: the test set is never smaller.
    sizes = np.cumsum(np.bincount(square)[order])
    count = int(np.searchsorted(sizes, share * len(rows))) + 1
    if count >= len(order):
        raise DataError(
            f"split=blocks: {len(order)} squares of {side:.3g} m, too few to hold some out; lower "
            "split.side_m or split.share"
        )
    return rows[np.isin(square, order[:count])]


def corner_fold(positions: np.ndarray, settings: SplitSettings) -> TrainTest:
    """A rectangle in one corner of the site, seen from above,
    holding `test_fraction` of the rows.
    """
    lower, extent = positions[:, :2].min(axis=0), np.ptp(positions[:, :2], axis=0)
    # A site without extent along an axis is divided by 1: that axis tells no row from another.
    unit = (positions[:, :2] - lower) / np.where(extent > 0, extent, 1.0)
    corner = np.array([sign == "+" for sign in settings.corner], dtype=np.float64)
    # The larger of the two distances: its level lines are rectangles about the corner.
    depth = np.abs(unit - corner).max(axis=1)
    count = max(round(settings.test_fraction * len(positions)), 1)
    test = np.sort(np.argsort(depth, kind="stable")[:count])
    rest = np.setdiff1d(np.arange(len(positions)), test)
    return rows_far_from(positions, rest, test, settings.buffer_m), test

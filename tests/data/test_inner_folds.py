"""Folds inside the training rows are cut as the test rows were cut from all."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsparc.base.errors import DataError
from gsparc.data.inner_folds import NOT_TESTED, inner_folds
from gsparc.data.split_settings import FileSettings, SplitSettings
from gsparc.data.splits import Fold, make_split

KINDS = ("random", "grouped", "corner", "blocks", "sparse")
SIDE = 0.2


def floor(rows: int = 600, seed: int = 0) -> np.ndarray:
    """Places all over a square of 1 m."""
    return np.random.default_rng(seed).uniform(0, 1, (rows, 3)) * [1, 1, 0.01]


def settings_of(name: str, **more) -> SplitSettings:
    return SplitSettings(name, **{"side_m": SIDE, "train_fraction": 0.3, "buffer_m": 0.01, **more})


def both(name: str, positions: np.ndarray, count: int = 3, seed: int = 0, **more):
    settings = settings_of(name, **more)
    outer = make_split(positions - positions.min(axis=0), settings).folds[0]
    return outer, inner_folds(positions, outer, settings, count, seed)


def apart(positions: np.ndarray, fold: Fold) -> float:
    """Median distance of a test row to the nearest row that is learned from [m]."""
    known = positions[np.concatenate([fold.train, fold.val])]
    return float(np.median(cKDTree(known).query(positions[fold.test])[0]))


@pytest.mark.parametrize("name", KINDS)
def test_left_out_rows_lie_as_far_from_the_others_as_test_rows_do(name):
    positions = floor()
    outer, inner = both(name, positions)
    assert inner.name == ("random" if name == "sparse" else name) and len(inner.folds) == 3
    far = np.mean([apart(positions, fold) for fold in inner.folds])
    assert far == pytest.approx(apart(positions, outer), rel=0.45)


@pytest.mark.parametrize("name", KINDS)
def test_they_are_of_training_rows_alone_and_a_pure_function(name):
    positions = floor()
    outer, inner = both(name, positions)
    known = np.union1d(outer.train, outer.val)
    for fold in inner.folds:
        every = np.concatenate([fold.train, fold.val, fold.test])
        assert len(np.unique(every)) == len(every) and np.isin(every, known).all()
        assert len(fold.train) and len(fold.val) and len(fold.test)
    assert (inner.unit[outer.test] == NOT_TESTED).all()
    tested = np.unique(np.concatenate([fold.test for fold in inner.folds]))
    assert (inner.unit[tested] != NOT_TESTED).all()
    again, other = both(name, positions)[1], both(name, positions, seed=1)[1]
    assert all(
        np.array_equal(a.test, b.test) for a, b in zip(inner.folds, again.folds, strict=True)
    )
    assert any(
        not np.array_equal(a.test, b.test) for a, b in zip(inner.folds, other.folds, strict=True)
    )


def test_squares_are_made_smaller_where_two_are_left():
    positions = floor() * [1, 0.3, 1]
    _, inner = both("blocks", positions, side_m=0.34)
    assert inner.name == "blocks" and len(inner.folds) == 3
    assert all(len(fold.val) and len(fold.test) for fold in inner.folds)


@pytest.mark.parametrize("together", [0, 2])
def test_whole_stations_are_left_out(together):
    station = np.repeat(np.arange(8), 30)
    positions, settings = floor(240), SplitSettings("stations", leave_out=together)
    outer = make_split(positions, settings, station=station).folds[0]
    inner = inner_folds(positions, outer, settings, 3, 0, station=station)
    assert inner.name == "stations" and len(inner.folds) == 3
    for fold in inner.folds:
        assert len(np.unique(station[fold.test])) == max(together, 1)
        assert not np.isin(station[fold.test], station[np.union1d(fold.train, fold.val)]).any()


def test_of_two_stations_each_is_left_out_and_of_one_rows_are():
    station, positions = np.repeat([3, 5], 20), floor(40)
    rows, none = np.arange(40), np.zeros(0, np.int64)
    settings = SplitSettings("stations")
    inner = inner_folds(positions, Fold(rows, none, none), settings, 3, 0, station=station)
    assert [set(station[f.test]) for f in inner.folds] == [{3}, {5}]
    alone = inner_folds(positions, Fold(rows[:20], none, none), settings, 3, 0, station=station)
    assert alone.name == "random" and len(alone.folds) == 3


@pytest.mark.parametrize("name", ["random", "blocks"])
def test_a_files_own_rows_say_how_they_were_cut(name):
    positions = floor(1200)
    outer = make_split(positions, settings_of(name)).folds[0]
    inner = inner_folds(positions, outer, FileSettings(path="split.json"), 3, 0)
    assert inner.name == name
    gap = apart(positions, Fold(outer.train, outer.train[:0], outer.val))
    assert np.mean([apart(positions, fold) for fold in inner.folds]) == pytest.approx(gap, rel=0.5)


def test_too_few_places_are_refused():
    rows, none = np.arange(3), np.zeros(0, np.int64)
    with pytest.raises(DataError, match="1 training places are too few"):
        inner_folds(floor(3), Fold(rows, none, none), None, 3, 0, place=np.zeros(3, np.int64))
    few = inner_folds(floor(3), Fold(rows, none, none), None, 5, 0)
    assert all(len(fold.train) and len(fold.test) for fold in few.folds)

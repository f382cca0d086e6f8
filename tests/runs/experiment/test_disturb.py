"""Errors disturb only what they are said to disturb, and every variant sees the same ones."""

from dataclasses import replace

import numpy as np
import pytest
from invented import divide, invent
from rooms import directed

from gsparc.runs.experiment.disturb import (
    Disturbance,
    add_direction_errors,
)


def test_directions_turn_by_what_was_asked_and_nothing_else():
    data, _, _ = directed(40)
    there = add_direction_errors(data, 2.0, seed=0)
    angle = np.linalg.norm(
        np.concatenate(there.directions) - np.concatenate(data.directions), axis=1
    )
    assert abs(np.degrees(np.sqrt(np.mean(angle**2) / 2)) - 2) < 0.2
    assert there.target is data.target and there.rx_position is data.rx_position
    few = add_direction_errors(data, 0.0, seed=0, missing=0.5)
    more = add_direction_errors(data, 0.0, seed=0, false=0.5)
    counts = [sum(map(len, d.directions)) for d in (few, data, more)]
    assert counts[0] < 0.6 * counts[1] and counts[2] > 1.4 * counts[1]
    with pytest.raises(ValueError, match="no directions of arrival"):
        add_direction_errors(replace(few, directions=None), 1.0, seed=0)


def test_what_is_learned_from_and_what_is_asked_are_disturbed_apart():
    data, split = invent(rows=400), divide(400, 2)
    assert Disturbance().learned(data, split) is None and Disturbance().asked(data, split) is data
    moved, folds = Disturbance(train_m=0.1, known=True, keep=0.5, seed=3).learned(data, split)
    assert np.std(moved.tx - data.tx) == pytest.approx(0.1, rel=0.1)
    assert (moved.position_std == 0.1).all() and moved.target is data.target
    assert [len(fold.learned()) for fold in folds.folds] == [
        round(len(fold.learned()) / 2) for fold in split.folds
    ]
    assert all(a.test is b.test for a, b in zip(folds.folds, split.folds, strict=True))
    asked = Disturbance(queries_m=0.1).asked(data, split)
    tested = np.concatenate([fold.test for fold in split.folds])
    still = np.setdiff1d(np.arange(400), tested)
    assert np.array_equal(asked.tx[still], data.tx[still])
    assert np.std(asked.tx[tested] - data.tx[tested]) == pytest.approx(0.1, rel=0.1)

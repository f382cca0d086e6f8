"""Errors disturb only what they are said to disturb, and every variant sees the same ones."""

import numpy as np
import pytest
from invented import divide, invent

from gsparc.runs.experiment.disturb import (
    Disturbance,
)


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

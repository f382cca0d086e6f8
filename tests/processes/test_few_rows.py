"""Few rows of many: half of them heard, or one in each cell of a site."""

import numpy as np

from gsparc.processes.few_rows import covering_rows
from gsparc.processes.powers import PowerRows


def test_drawn_rows_keep_half_of_what_was_heard():
    every = PowerRows(
        np.zeros((1000, 3)), np.arange(1000.0), (np.arange(1000) >= 100).astype(np.int8)
    )
    rows = every.draw_subset(150, 0)
    assert (
        len(rows.side) == 150 and (~rows.silent).sum() == 75 and (np.diff(rows.decibels) > 0).all()
    )
    assert (~every.draw_subset(300, 0).silent).sum() == 100
    assert np.array_equal(every.draw_subset(1000, 0).decibels, np.arange(1000))


def test_a_parked_car_counts_no_more_than_a_street():
    rng = np.random.default_rng(0)
    parked = 5 + 1e-3 * rng.normal(size=(9000, 2))
    places = np.concatenate([parked, rng.uniform(0, 1000, (1000, 2))])
    chosen = covering_rows(places, 500, 0)
    assert len(chosen) == 500 and len(np.unique(chosen)) == 500
    assert (chosen >= 9000).mean() > 0.75
    assert np.array_equal(covering_rows(places[:300], 500, 0), np.arange(300))
    assert len(covering_rows(np.zeros((50, 3)), 20, 0)) == 20

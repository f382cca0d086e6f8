"""Few rows of many: half of them heard, or one in each cell of a site."""

import numpy as np

from gsparc.processes.few_rows import covering_rows, sample_place_rows
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


def test_one_row_less_was_another_sample():
    """Answers moved by 2 dB with a hundredth of the rows, as draws went by their numbers."""
    rng = np.random.default_rng(0)
    places, level = rng.uniform(0, 1000, (5000, 3)), rng.normal(-80, 9, 5000)
    every = PowerRows(places, level, np.zeros(5000, np.int8))
    left = np.sort(rng.permutation(5000)[50:])
    draws = {
        "rows": lambda rows: every.subset(rows).draw_subset(300, 0).places,
        "places": lambda rows: places[rows][sample_place_rows(places[rows], 300, 0)],
        "cells": lambda rows: places[rows][covering_rows(places[rows], 300, 0)],
    }
    for name, draw in draws.items():
        whole, less = (set(map(tuple, draw(rows))) for rows in (np.arange(5000), left))
        assert len(whole & less) > 280, name

"""Rows that a method did not learn from."""

import numpy as np

from gsparc.prediction.left_out import Evidence, nearest_distances


def test_distance_is_to_rows_of_the_same_station():
    known, station = np.array([[0.0, 0, 0], [10, 0, 0]]), np.array([0, 1])
    places = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    assert nearest_distances(known, station, places, np.array([0, 1, 2])).tolist() == [
        1.0,
        9.0,
        1.0,
    ]


def test_a_row_of_two_folds_counts_once_by_the_first():
    """Folds and seeds share test rows; a score that one fold lacks ranks nothing."""
    place = np.zeros((3, 3))
    one = Evidence(
        np.array([4, 2, 7]), place, np.array([0.1, 0.2, 0.3]), {"expected": np.arange(3.0)}
    )
    other = {"learned": np.ones(3), "expected": -np.arange(3.0)}
    both = Evidence.join([one, Evidence(np.array([2, 5, 4]), place, np.ones(3), other)])
    assert both.row.tolist() == [4, 2, 7, 5] and both.error.tolist() == [0.1, 0.2, 0.3, 1.0]
    assert both.scores.keys() == {"expected"} and both.scores["expected"].tolist() == [0, 1, 2, -1]

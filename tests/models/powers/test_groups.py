"""Groups of places, folds of them, and what one prior gains over another."""

import numpy as np
import pytest

from gsparc.models.powers.groups import compare_errors, number_squares, split_groups


def test_groups_are_squares_and_stay_whole():
    places = np.random.default_rng(0).uniform(size=(500, 3)) * [20, 10, 1]
    group = number_squares(places)
    assert group.max() + 1 == 50
    parts = split_groups(group, 3, seed=0)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(500))
    assert not any(
        set(group[one]) & set(group[other]) for one in parts for other in parts if one is not other
    )


def test_one_place_is_one_fold():
    assert [len(part) for part in split_groups(number_squares(np.ones((7, 3))), 3, 0)] == [7]


def test_a_gain_counts_groups_not_rows():
    one, other = np.ones(400), np.full(400, 2.0)
    group = np.repeat(np.arange(4), 100)
    assert compare_errors(one**2, other**2, group).exceeds(2.0)
    other[group > 0] = 0.9  # one group gains, three lose
    gain = compare_errors(one**2, other**2, group)
    assert gain.squares == pytest.approx((3.0 + 3 * (0.81 - 1)) / 4)
    assert gain.exceeds(0.0) and not gain.exceeds(1.0)

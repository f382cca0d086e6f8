"""Groups of places, folds of them."""

import numpy as np

from gsparc.models.powers.groups import number_squares, split_groups


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

"""Who may still add to the best, and who misses what it misses, however good it becomes."""

import numpy as np
import pytest
import torch

from gsparc.training.race import FellBehind, Race

ROWS = np.arange(60)
OWN = torch.randn(2, 60, 2, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))


def race(looks=None):
    target = torch.full((60, 2), 10.0, dtype=torch.complex64)
    return Race.from_mean(
        ROWS, target + OWN[0], target, lambda *look: None if looks is None else looks.append(look)
    )


def test_a_candidate_behind_goes_on_where_its_errors_are_its_own():
    looks = []
    one = race(looks)
    assert one.error == pytest.approx(0.01, rel=0.2)
    one.check_candidate("behind", ROWS, 1.5 * OWN[1])
    assert looks == [("behind", pytest.approx(2.25, rel=0.2))]


def test_a_candidate_ends_that_stays_far_behind():
    one = race()
    with pytest.raises(
        FellBehind, match=r"^far: \d+ times the error of the best so far \(error 0\.0"
    ):
        one.check_candidate("far", ROWS, 5 * OWN[1], [25.0])
    assert one.check_candidate("falling", ROWS, 5 * OWN[1], [100.0]) == pytest.approx(25, rel=0.2)


def test_a_candidate_ends_that_misses_what_the_best_misses():
    with pytest.raises(
        FellBehind,
        match=r"^near: averaging it with the best so far \(error 0\.0\d+ .* gains -?\d+% ±",
    ):
        race().check_candidate("near", ROWS, OWN[0] + 0.1 * OWN[1])
    falling = race().check_candidate("falling", ROWS, OWN[0] + 0.1 * OWN[1], [3.0])
    assert falling == pytest.approx(1, rel=0.2)


def test_a_search_that_had_ended_went_on_for_what_no_mean_gained():
    """Looked at once, when all its sources were found, it was never held against the best."""
    missed = 1.5 * OWN[0] + OWN[1]
    assert race().check_candidate("first", ROWS, missed, []) > 1
    with pytest.raises(FellBehind, match=r"gains -?\d+% ±"):
        race().check_candidate("ended", ROWS, missed, [], finished=True)


def test_only_rows_that_both_left_out_are_compared():
    rows = np.r_[ROWS[30:][::-1], 100 + ROWS]
    with pytest.raises(FellBehind):
        race().check_candidate("one", rows, torch.cat([OWN[0, 30:].flip(0), -9 * OWN[0]]))

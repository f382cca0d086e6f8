"""Schedules of shares act where they fall in a training of any length,
and not at all in a very short one.
"""

import pytest

from gsparc.field.schedule import FIRST, INTERVAL, STEPS, acts_at_step, to_steps


@pytest.mark.parametrize(("given", "steps"), [(0, 0), (7, 7), (0.25, 100), (0.001, 1)])
def test_numbers_are_steps_and_shares_are_of_all(given, steps):
    assert to_steps(given, 400) == steps


def test_what_is_neither_is_refused():
    for wrong in (-1, 1.5, 0.0, True, "0.1", None):
        assert not STEPS.holds(wrong) and not INTERVAL.holds(wrong), wrong
    assert STEPS.holds(0) and not INTERVAL.holds(0)


@pytest.mark.parametrize("total", [200, 400, 4000])
def test_shares_act_as_often_however_long_the_training_is(total):
    acted = [s for s in range(total + 1) if acts_at_step(s, 0.25, 0.75, 0.125, total)]
    assert acted == [total * k // 8 for k in range(2, 7)]


def test_a_short_training_is_left_alone_unless_steps_are_named():
    total = FIRST - 1
    assert not any(acts_at_step(s, 0.1, 0.9, 0.05, total) for s in range(total + 1))
    assert acts_at_step(2, 1, 10, 2, total)

"""Schedules written as numbers of steps,
or as shares of a training whose length is not yet known.
"""

from __future__ import annotations

from gsparc.base.limits import Limit

FIRST = 50  # steps of gradient before a schedule of shares acts

STEPS = Limit(
    "a whole number of steps, or a share of all steps between 0 and 1",
    lambda v: (type(v) is int and v >= 0) or (isinstance(v, float) and 0 < v < 1),
)
INTERVAL = Limit(
    "a whole number of at least 1 step, or a share of all steps between 0 and 1",
    lambda v: STEPS.holds(v) and v > 0,
)


def to_steps(given: int | float, total: int) -> int:
    """Return the step that `given` means in a training of `total` steps;
    a share is of one step at least.
    """
    return given if isinstance(given, int) else max(1, round(given * total))


def acts_at_step(
    step: int, start: int | float, stop: int | float, interval: int | float, total: int
) -> bool:
    """Tell whether a callback acts at a step: on a multiple of `interval` from `start` to `stop`.

    Where the interval is a share, not before `FIRST` steps were taken: a training that short has
    gradients of its initial weights alone, and would not recover.

    Args:
        step: of gradient so far.
        start, stop, interval: steps, or shares.
        total: steps of the schedule.
    """
    first, last, period = (to_steps(value, total) for value in (start, stop, interval))
    if isinstance(interval, float) and step < FIRST:
        return False
    return first <= step <= last and step % period == 0

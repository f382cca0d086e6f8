"""Ending work from outside: threads cannot be interrupted, and loops do not know when,
so they ask.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

_asked = threading.local()


class Cancelled(BaseException):
    """Raised in a thread whose work is no longer wanted."""


@contextmanager
def _add_condition(name: str, condition: Callable[[], bool]) -> Iterator[None]:
    """Within, this thread is asked `condition` as `name`, beside what surrounds it."""
    before = getattr(_asked, name, None)
    # What surrounds it is asked first: an outer end is one of all within.
    setattr(_asked, name, condition if before is None else lambda: before() or condition())
    try:
        yield
    finally:
        setattr(_asked, name, before)


def cancel_when(condition: Callable[[], bool]) -> AbstractContextManager[None]:
    """Make `raise_if_cancelled` raise, within, as soon as `condition`, or who surrounds it,
    says so.
    """
    return _add_condition("unwanted", condition)


def raise_if_cancelled() -> None:
    """Raise `Cancelled` if this thread's work is unwanted;
    each factor and block of candidates asks.
    """
    _asked.steps = getattr(_asked, "steps", 0) + 1
    unwanted = getattr(_asked, "unwanted", None)
    if unwanted is not None and unwanted():
        raise Cancelled


def end_when(condition: Callable[[], bool]) -> AbstractContextManager[None]:
    """Make `out_of_steps` say, within, what `condition`, or who surrounds it, says, in this thread.

    >>> with end_when(lambda: True):
    ...     out_of_steps()
    True
    >>> out_of_steps()
    False
    """
    return _add_condition("over", condition)


def step_limit(steps: int) -> Callable[[], bool]:
    """Return a call: whether this thread has made `steps` further factors
    and blocks of candidates.
    """
    end = getattr(_asked, "steps", 0) + steps
    return lambda: getattr(_asked, "steps", 0) >= end


def out_of_steps() -> bool:
    """Tell whether this thread's effort is spent:
    a loop of many steps then ends with what it has.
    """
    over = getattr(_asked, "over", None)
    return over is not None and over()

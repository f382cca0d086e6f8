"""Ending work from outside: threads cannot be interrupted, and loops do not know the clock, so they ask."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_asked = threading.local()


class Ended(BaseException):
    """Raised in a thread whose work is no longer wanted."""


@contextmanager
def ended_by(unwanted: Callable[[], bool]) -> Iterator[None]:
    """Within, `ask` raises `Ended` in this thread as soon as `unwanted`, or who surrounds it, says so."""
    before = getattr(_asked, "unwanted", None)
    _asked.unwanted = unwanted if before is None else lambda: before() or unwanted()
    try:
        yield
    finally:
        _asked.unwanted = before


def ask() -> None:
    """Raise `Ended` if this thread's work is unwanted; called wherever a tenth of a second has gone by."""
    unwanted = getattr(_asked, "unwanted", None)
    if unwanted is not None and unwanted():
        raise Ended


@contextmanager
def late_when(over: Callable[[], bool]) -> Iterator[None]:
    """Within, `late` says what `over`, or who surrounds it, says, in this thread."""
    before = getattr(_asked, "over", None)
    _asked.over = over if before is None else lambda: before() or over()
    try:
        yield
    finally:
        _asked.over = before


def late() -> bool:
    """Whether this thread's time is over: a loop of more than a second then ends with what it has."""
    over = getattr(_asked, "over", None)
    return over is not None and over()


def stop_when_late(*unused: object) -> None:
    """The callback of `scipy.optimize.minimize`: no step follows when it is late."""
    if late():
        raise StopIteration

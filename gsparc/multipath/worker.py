"""Ending what a worker thread does from outside: threads cannot be interrupted, so they ask."""

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

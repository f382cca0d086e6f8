"""How long, in its own processor time, a fit goes without looking at the clock or at interrupts."""

import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from unittest import mock

from gsparc.processes import worker
from gsparc.training.time_budget import TimeBudget

OFTEN_S = 0.02  # between signals, as Ctrl-C would come


@dataclass
class Looks:
    """The longest that any thread computed between two looks [s], and where the second look was."""

    clock: tuple[float, str] = (0.0, "")
    interrupt: tuple[float, str] = (0.0, "")
    _last: dict[tuple[str, int], float] = field(default_factory=dict)

    def look(self, at: str, frame: FrameType | None = None) -> None:
        """This thread looks at `at` now."""
        key, now = (at, threading.get_ident()), time.thread_time()
        gap = now - self._last.get(key, now)
        self._last[key] = now
        if gap > getattr(self, at)[0]:
            stack = traceback.extract_stack(frame or sys._getframe(2), limit=9)
            where = " < ".join(f"{one.filename.rpartition('/')[2]}:{one.lineno}" for one in stack[::-1])
            setattr(self, at, (gap, where))


@contextmanager
def watched() -> Iterator[Looks]:
    """Watch the block: budgets read, workers that ask whether to end, signals in this, the main thread."""
    looks = Looks()
    counted, ask = TimeBudget.counted.fget, worker.raise_if_cancelled

    def reads(budget: TimeBudget):
        looks.look("clock")
        return counted(budget)

    def asks() -> None:
        if threading.current_thread() is not threading.main_thread():
            looks.look("interrupt")
        ask()

    modules = [m for m in list(sys.modules.values()) if getattr(m, "raise_if_cancelled", None) is ask]
    before = signal.signal(signal.SIGALRM, lambda signum, frame: looks.look("interrupt", frame))
    signal.setitimer(signal.ITIMER_REAL, OFTEN_S, OFTEN_S)
    try:
        with mock.patch.object(TimeBudget, "counted", property(reads)):
            for module in modules:
                module.raise_if_cancelled = asks
            looks.look("clock")
            yield looks
            looks.look("clock")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        for module in modules:
            module.raise_if_cancelled = ask

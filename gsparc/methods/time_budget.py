"""Seconds that a fit may take, by the clock on the wall or by processor time, and whether they ended it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import torch

Clock = Literal["wall", "processor"]


def clock_of(clock: Clock) -> Callable[[], float]:
    """Seconds from an arbitrary beginning; `processor`: of all threads, divided by torch's number of them."""
    threads = torch.get_num_threads()
    return time.monotonic if clock == "wall" else lambda: time.process_time() / threads


class TimeBudget:
    """Counts from where it is made.

    A busy machine does less within seconds of the wall, about the same within seconds of its processor;
    only fixed numbers of steps or searches repeat a result exactly.

    Args:
        seconds: all of them [s].
        clock: see `clock_of`.
        spent_s: before, by the run that this one goes on from [s].

    Attributes:
        limited: whether `over` has ended something.
    """

    def __init__(self, seconds: float, clock: Clock = "wall", spent_s: float = 0.0) -> None:
        self.seconds, self.clock, self.limited = seconds, clock, False
        self._now = clock_of(clock)
        self._started = self._now() - spent_s

    @property
    def spent(self) -> float:
        """[s]"""
        return self._now() - self._started

    def over(self, share: float = 1.0) -> bool:
        """Whether that share of it is spent; whoever asks then ends what it does."""
        found = self.spent > share * self.seconds
        self.limited |= found
        return found

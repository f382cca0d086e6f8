"""Seconds that a fit may take, by the clock on the wall or by processor time, and whether they ended it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Literal

import torch

Clock = Literal["wall", "processor"]


@dataclass(frozen=True)
class Spent:
    """Seconds of the same work by both clocks.

    Attributes:
        wall: [s]
        processor: of all threads, divided by torch's number of them [s].
    """

    wall: float = 0.0
    processor: float = 0.0

    def by(self, clock: Clock) -> float:
        """[s]"""
        return self.wall if clock == "wall" else self.processor

    def __add__(self, other: Spent) -> Spent:
        return Spent(self.wall + other.wall, self.processor + other.processor)

    def __sub__(self, other: Spent) -> Spent:
        return Spent(self.wall - other.wall, self.processor - other.processor)


NOTHING = Spent()


def less_repeatable(*clocks: Clock | None) -> Clock | None:
    """Of clocks that decided something, the one whose seconds repeat a result worst; None of none."""
    return "wall" if "wall" in clocks else next(filter(None, clocks), None)


class TimeBudget:
    """Counts from where it is made, but for pauses.

    A busy machine does less within seconds of the wall, about the same within seconds of its processor;
    only fixed numbers of steps or searches repeat a result exactly.

    Args:
        seconds: all of them [s].
        clock: whose seconds they are.
        before: spent by the run that this one goes on from.

    Attributes:
        limited: whether `over` has ended something.
    """

    def __init__(self, seconds: float = math.inf, clock: Clock = "wall", before: Spent = NOTHING) -> None:
        self.seconds, self.clock, self.limited = seconds, clock, False
        self._threads = torch.get_num_threads()  # searches change it for a while
        self._before = before
        self._since: Spent | None = self._now()

    def _now(self) -> Spent:
        return Spent(time.monotonic(), time.process_time() / self._threads)

    @property
    def counted(self) -> Spent:
        """By both clocks."""
        return self._before if self._since is None else self._before + (self._now() - self._since)

    @property
    def spent(self) -> float:
        """[s]"""
        return self.counted.by(self.clock)

    @property
    def limited_by(self) -> Clock | None:
        """The clock, if it has ended something."""
        return self.clock if self.limited else None

    def charge(self, more: Spent) -> None:
        """Count what was spent elsewhere, too."""
        self._before = self._before + more

    def pause(self) -> None:
        """Count no more until `go`."""
        self._before, self._since = self.counted, None

    def go(self) -> None:
        """Count again."""
        if self._since is None:
            self._since = self._now()

    def moved(self) -> None:
        """Count on in another process, whose processor time began with it."""
        if self._since is not None:
            self._since = Spent(self._since.wall, 0.0)

    def over(self, share: float = 1.0) -> bool:
        """Whether that share of it is spent; whoever asks then ends what it does."""
        result = self.spent > share * self.seconds
        self.limited |= result
        return result

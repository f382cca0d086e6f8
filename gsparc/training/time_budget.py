"""What a fit counts before it ends (`Effort`), and the seconds that may end it before (`TimeBudget`)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, fields
from typing import Literal

import torch

Clock = Literal["wall", "processor"]


LEAST_ROWS = 150  # that settings are chosen on, however little the effort


@dataclass(frozen=True)
class Effort:
    """How much a fit counts before it ends: the same on every machine, however busy it is.

    Attributes:
        chosen_on: rows that settings are chosen on, of more; each look at them factors a covariance.
        term_rows: rows that powers of the terms of a channel field are learned on.
        evaluations: of a search for sources: factors of covariances and blocks of candidates.
        fringes: coherent solutions of powers.
        restarts: of spectra that no neighbour solves, times the starts of each.
        steps, steps_after_solving: of gradient, where neither model nor Trainer is given a number; after a
            start in closed form.
    """

    chosen_on: int = 1_000
    term_rows: int = 400
    evaluations: int = 3_000
    fringes: int = 20
    restarts: int = 100_000
    steps: int = 400
    steps_after_solving: int = 60

    def scale_by(self, factor: float) -> Effort:
        """Return all of it times `factor`; rows times its cube root, as a covariance of n rows takes n^3."""
        counts = {one.name: factor * getattr(self, one.name) for one in fields(self)}
        rows = {name: max(factor ** (1 / 3) * getattr(self, name), LEAST_ROWS) for name in ROWS}
        return Effort(**{name: max(round(count), 1) for name, count in {**counts, **rows}.items()})


ROWS = ("chosen_on", "term_rows")


@dataclass(frozen=True)
class Spent:
    """Seconds of the same work by both clocks.

    Attributes:
        wall: [s]
        processor: of all threads, divided by torch's number of them [s].
    """

    wall: float = 0.0
    processor: float = 0.0

    def __add__(self, other: Spent) -> Spent:
        return Spent(self.wall + other.wall, self.processor + other.processor)

    def __sub__(self, other: Spent) -> Spent:
        return Spent(self.wall - other.wall, self.processor - other.processor)


NOTHING = Spent()


def worst_clock(*clocks: Clock | None) -> Clock | None:
    """Return, of clocks that decided something, the one whose seconds repeat results worst; None of none."""
    return "wall" if "wall" in clocks else next(filter(None, clocks), None)


class TimeBudget:
    """Counts from where it is made.

    Seconds decide nothing but an early end: what a fit does is counted (`Effort`), and repeats exactly.

    Args:
        seconds: all of them [s].
        clock: whose seconds they are.
        before: spent by the run that this one goes on from.
        effort: what is counted within them.

    Attributes:
        limited: whether `over` has ended something.
    """

    def __init__(
        self, seconds: float = math.inf, clock: Clock = "wall", before: Spent = NOTHING,
        effort: Effort = Effort(),
    ) -> None:  # fmt: skip
        self.effort = effort
        self.seconds, self.clock, self.limited = seconds, clock, False
        self._threads = torch.get_num_threads()  # searches change it for a while
        self._before = before
        self._since = self._read_clocks()

    def _read_clocks(self) -> Spent:
        # Seconds of threads add up: divided, both clocks agree where all of them work.
        return Spent(time.monotonic(), time.process_time() / self._threads)

    @property
    def by_clock(self) -> Spent:
        """Seconds by both clocks."""
        return self._before + (self._read_clocks() - self._since)

    @property
    def spent(self) -> float:
        """[s]"""
        return self.by_clock.wall if self.clock == "wall" else self.by_clock.processor

    @property
    def left_s(self) -> float | None:
        """What is left of it, more than nothing; None without an end [s]."""
        # Never 0, as a context refuses a budget that is not positive.
        return None if math.isinf(self.seconds) else max(self.seconds - self.spent, 1e-3)

    @property
    def limited_by(self) -> Clock | None:
        """The clock, if it has ended something."""
        return self.clock if self.limited else None

    def charge(self, more: Spent) -> None:
        """Count what was spent elsewhere, too."""
        self._before = self._before + more

    def restart(self) -> None:
        """Count on from now, with what was counted as spent before: what another process goes on from."""
        self._before, self._since = self.by_clock, self._read_clocks()

    def restart_processor(self) -> None:
        """Count on in another process, whose processor time began with it."""
        # The wall's clock is the machine's; a new process's own begins at 0.
        self._since = Spent(self._since.wall, 0.0)

    def is_spent(self) -> bool:
        """Tell whether it is spent; whoever asks then ends what it does."""
        result = self.spent > self.seconds
        # For good: what it ended stays ended, though time may be charged later.
        self.limited |= result
        return result

"""Seconds of a fit, for its report and its curve: they decide nothing."""

from __future__ import annotations

import time


class Stopwatch:
    """Counts from where it is made.

    Args:
        before: seconds of the run that this one goes on from.
    """

    def __init__(self, before: float = 0.0) -> None:
        self._since = time.monotonic() - before  # the machine's clock: another process reads it alike

    @property
    def seconds(self) -> float:
        """[s]"""
        return time.monotonic() - self._since

    def charge(self, more: float) -> None:
        """Count what was spent elsewhere, too."""
        self._since -= more

"""Seconds of a fit, for its report and its curve: they decide nothing."""

from __future__ import annotations

import time


class Stopwatch:
    """Counts from where it is made, by the clock and of the processor.

    Args:
        before: seconds of the run that this one goes on from.
        cpu_before: its processor seconds.

    Attributes:
        cpu_elsewhere: processor seconds that were not spent in this process [s].
    """

    def __init__(self, before: float = 0.0, cpu_before: float = 0.0) -> None:
        # The machine's clock: another process reads it alike
        self._since = time.monotonic() - before
        self._cpu_since, self.cpu_elsewhere = time.process_time(), cpu_before

    def __getstate__(self) -> dict[str, float]:
        return {**vars(self), "cpu_elsewhere": self.cpu_seconds}

    def __setstate__(self, state: dict[str, float]) -> None:
        # Another process has a count of its own
        vars(self).update(state, _cpu_since=time.process_time())

    @property
    def seconds(self) -> float:
        """[s]"""
        return time.monotonic() - self._since

    @property
    def cpu_seconds(self) -> float:
        """Of all threads, waiting for others excluded [s]."""
        return time.process_time() - self._cpu_since + self.cpu_elsewhere

    def charge(self, more: float, cpu: float = 0.0) -> None:
        """Count what was spent elsewhere, too."""
        self._since -= more
        self.cpu_elsewhere += cpu

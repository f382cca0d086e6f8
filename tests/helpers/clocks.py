"""A clock that tests wind: seconds pass when a call says so, on however busy a machine."""

from types import SimpleNamespace

TICK_S = 1e-4  # that every look at the clock takes, so that nothing takes no time at all


class WoundClock:
    """In the place of a clock of `time`."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        self.now += TICK_S
        return self.now

    def wind(self, seconds: float) -> None:
        """Let time pass [s]."""
        self.now += seconds


def wound(monkeypatch) -> SimpleNamespace:
    """The clocks that every stopwatch looks at."""
    clocks = SimpleNamespace(monotonic=WoundClock(), process_time=WoundClock())
    monkeypatch.setattr("gsparc.training.stopwatch.time", clocks)
    return clocks

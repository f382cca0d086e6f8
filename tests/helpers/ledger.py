"""What the tests measured while they ran: worst errors, examples, seconds and counts, case by case.

`tests/hard_cases/conftest.py` says which test is running and writes the table of docs/hard-cases.md from it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from statistics import median


@dataclass
class Tally:
    """What one engine in one precision did for one case.

    Attributes:
        times: seconds of each forward and backward pass.
        worst: part ("forward", "backward") -> largest error, relative to one plus the largest value wanted.
        share: part -> the same error as a share of what was allowed.
    """

    times: list[float] = field(default_factory=list)
    worst: dict[str, float] = field(default_factory=dict)
    share: dict[str, float] = field(default_factory=dict)

    @property
    def examples(self) -> int:
        """Number of passes."""
        return len(self.times)

    @property
    def median_ms(self) -> float:
        """Their median time [ms]."""
        return 1e3 * median(self.times)


@dataclass
class Told:
    """How the tests of one case ended, and their time [s]."""

    passed: int = 0
    failed: int = 0
    seconds: float = 0.0


class Ledger:
    """One per test session."""

    def __init__(self) -> None:
        self.case = "other"
        self.engine: str | None = None  # who stands in for the CPU's kernels; None: nobody
        self.tallies: dict[tuple[str, str, str], Tally] = defaultdict(Tally)
        self.tests: dict[str, Told] = defaultdict(Told)
        self.counts: dict[str, Counter[str]] = defaultdict(Counter)
        self.seeds: dict[str, list[tuple[float, float]]] = defaultdict(list)

    def rendered(self, engine: str, precision: str, seconds: float) -> None:
        """One forward and backward pass."""
        self.tallies[self.case, engine, precision].times.append(seconds)

    def compared(self, engine: str, precision: str, part: str, error: float, allowed: float) -> None:
        """An error against the float64 reference, and what was allowed."""
        tally = self.tallies[self.case, engine, precision]
        tally.worst[part] = max(tally.worst.get(part, 0.0), error)
        tally.share[part] = max(tally.share.get(part, 0.0), error / allowed)

    def count(self, what: str, number: int = 1) -> None:
        """Examples of a property, bad inputs, kills, seeds."""
        self.counts[what][self.case] += number

    def seed(self, dataset: str, figure_db: float, seconds: float) -> None:
        """The error of one seed's short run [dB relative to the power], and what it took [s]."""
        self.count("seeds")
        self.seeds[dataset].append((figure_db, seconds))


LEDGER = Ledger()

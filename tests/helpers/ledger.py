"""What the tests measured while they ran: errors, seconds and counts, case by case.

`tests/hard_cases/conftest.py` says which test is running and writes the table
of docs/hard-cases.md from it.
"""

from collections import defaultdict
from dataclasses import dataclass, field


@dataclass
class Outcome:
    """How the tests of one case ended, and their time [s]."""

    passed: int = 0
    failed: int = 0
    seconds: float = 0.0


@dataclass
class Ledger:
    """One per test session.

    Attributes:
        case: what is being tested.
        engine: who stands in for the CPU's kernels; None: nobody.
        passes: case, engine, precision and seconds of each forward and backward pass.
        errors: case, engine, precision, part ("forward", "backward"), error relative to one plus
            the largest value wanted, and its share of what was allowed.
        tests: outcomes by case.
    """

    case: str = "other"
    engine: str | None = None
    passes: list[tuple[str, str, str, float]] = field(default_factory=list)
    errors: list[tuple[str, str, str, str, float, float]] = field(default_factory=list)
    tests: dict[str, Outcome] = field(default_factory=lambda: defaultdict(Outcome))

    def rendered(self, engine: str, precision: str, seconds: float) -> None:
        """One forward and backward pass."""
        self.passes.append((self.case, engine, precision, seconds))

    def compared(
        self, engine: str, precision: str, part: str, error: float, allowed: float
    ) -> None:
        """An error against the float64 reference, and what was allowed."""
        self.errors.append((self.case, engine, precision, part, error, error / allowed))


LEDGER = Ledger()

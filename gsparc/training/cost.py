"""Where the seconds of a fit went: what was tried, what it cost,
what of it had no weight in the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

LINE = "cost{of_what}: {cost}"  # of a log and of a summary
LEAST_S = 0.05  # of a stage that is named


@dataclass(frozen=True)
class Cost:
    """Seconds of the stages of a fit.

    Attributes:
        stages: of each [s].
        unused: stages whose result has no weight in what answers, or of which no step was kept.
    """

    stages: Mapping[str, float] = field(default_factory=dict)
    unused: Mapping[str, float] = field(default_factory=dict)

    def __add__(self, other: Cost) -> Cost:
        """Add the stages of two fits, such as those of two stations."""
        stages, unused = (
            # In the order in which stages came, which a set would lose.
            {name: a.get(name, 0.0) + b.get(name, 0.0) for name in dict.fromkeys([*a, *b])}
            for a, b in ((self.stages, other.stages), (self.unused, other.unused))
        )
        return Cost(stages, unused)

    @property
    def seconds(self) -> float:
        """Return the sum over all stages [s]."""
        return sum(self.stages.values())

    @property
    def unused_s(self) -> float:
        """Return the sum over stages without weight [s]."""
        return sum(self.unused.values())

    def describe(self) -> str:
        """Return one line."""
        parts = []
        for name, spent in self.stages.items():
            unused = f" ({self.unused[name]:.1f} s unused)" if name in self.unused else ""
            parts += [f"{name} {spent:.1f} s{unused}"] if spent >= LEAST_S else []
        total = f"{self.seconds:.1f} s"
        share = self.unused_s / max(self.seconds, LEAST_S)
        total = (
            (f"{share:.0%} of {total} spent on what is not used")
            if self.unused
            else f"{total} in all"
        )
        return f"{', '.join(parts)}; {total}"


NO_COST = Cost()

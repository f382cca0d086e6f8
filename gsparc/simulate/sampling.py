"""Effort of a solver of paths, and its calls."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Sampling:
    """Effort of the solver.

    Attributes:
        samples: rays per call; the convergence error falls with it.
        batch: receivers of one call.
        seed: of the rays; one for all batches, because receivers share candidate paths.
    """

    samples: int = 300_000
    batch: int = 200
    seed: int = 1

    @property
    def part(self) -> int:
        """Receivers of a call of fewer than a batch."""
        return math.ceil(self.batch / 3)


def divide_into_calls(receivers: int, batch: int) -> list[tuple[int, int]]:
    """Divide receivers into calls, each filled up to a batch, a third of one; of few a ninth ..."""
    size, whole = Sampling(batch=batch).part, receivers // batch if receivers > batch else 0
    while size > 1 and math.ceil(size / 3) >= receivers:
        size = math.ceil(size / 3)
    rest = receivers - whole * batch
    if whole and rest > 2 * size:
        return [*[(batch, batch)] * whole, (rest, batch)]
    return [
        *[(batch, batch)] * whole,
        *((min(size, rest - at), size) for at in range(0, rest, size)),
    ]

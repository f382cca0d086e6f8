"""On how many rows a choice of settings looks, and what may end it early."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gsparc.training.time_budget import Effort, TimeBudget

CHOSEN_ON = Effort().chosen_on


@dataclass(frozen=True)
class Haste:
    """What a choice of settings counts.

    Attributes:
        rows: that they are chosen on, of more.
        late: asked between looks; what was found so far is the choice when it says so.
    """

    rows: int = CHOSEN_ON
    late: Callable[[], bool] = lambda: False


UNHURRIED = Haste()


def haste(budget: TimeBudget | None) -> Haste:
    """That of a fit; None: the usual effort without an end."""
    return UNHURRIED if budget is None else Haste(budget.effort.chosen_on, budget.over)

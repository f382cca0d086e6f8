"""What the seconds that are left allow: on how many rows settings are chosen, and how many factors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from gsparc.processes.density import LeftOutDensity, gram_of
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import Kernel
from gsparc.training.time_budget import TimeBudget

CHOSEN_ON = 1_000  # rows that settings are chosen on: each look at them factors a matrix
FEWEST = 150  # of them
LOOKS = 80  # that a choice takes
TIMED_ON = 300  # rows
TRIES = 3  # the first makes room, and a busy machine makes one of them slow
MAKING = 1.5  # times a factor: with making the covariance
ONE = Kernel.of_one(1.0, 0.1)


@dataclass(frozen=True)
class Haste:
    """How much time there is to choose settings.

    Attributes:
        rows: that they are chosen on, of more.
        late: asked between looks; what was found so far is the choice when it says so.
    """

    rows: int = CHOSEN_ON
    late: Callable[[], bool] = lambda: False


UNHURRIED = Haste()


def haste(budget: TimeBudget | None, share: float, count: int) -> Haste:
    """That of a choice among `count` rows in so large a share of the seconds that are left.

    A look at n rows takes n^3.
    """
    if budget is None or not math.isfinite(budget.seconds):
        return UNHURRIED
    began = budget.spent
    share_s = share * max(budget.seconds - began, 0.0)
    values, at = torch.arange(TIMED_ON, dtype=torch.float64)[:, None], torch.from_numpy(ONE.parameters())
    tried = []
    for _ in range(TRIES):
        watch = TimeBudget()
        gram = gram_of(at.requires_grad_(), torch.cdist(values, values))
        LeftOutDensity.apply(gram, values, 1, True)[0].backward()  # type: ignore[no-untyped-call]
        tried.append(watch.spent)
    affordable = share_s / (LOOKS * max(min(tried), 1e-6))
    rows = min(int(TIMED_ON * affordable ** (1 / 3)), CHOSEN_ON)
    budget.limited |= rows < min(count, CHOSEN_ON)
    return Haste(max(rows, FEWEST), lambda: budget.over((began + share_s) / max(budget.seconds, 1e-9)))


def factor_s(rows: int) -> float:
    """About how long a complex covariance of so many rows takes to make and to factor here, now [s]."""
    few, tried = max(min(rows, TIMED_ON), 1), []
    for _ in range(TRIES):
        watch = TimeBudget()
        Factor.of(torch.eye(few, dtype=torch.complex128) + 0.5)
        tried.append(watch.spent)
    return MAKING * min(tried) * (rows / few) ** 3

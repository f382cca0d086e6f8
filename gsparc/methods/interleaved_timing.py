"""Warm single queries of many contenders, in turns, so that whatever else runs hits all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch

from gsparc.methods.timing import synchronise

Key = TypeVar("Key")


@dataclass(frozen=True)
class Pace:
    """How long to measure.

    Attributes:
        rounds: largest number of visits to every contender.
        least: rounds that are made even when they exceed the budget.
        calls: timed calls of a visit, after one that warms the caches.
        budget_s: no new round starts after this many seconds [s].
        seed: of the order of visits, another one each round.
    """

    rounds: int = 40
    least: int = 5
    calls: int = 4
    budget_s: float = 60.0
    seed: int = 0


def in_turns(
    contenders: Mapping[Key, Callable[[int], object]], threads: Mapping[Key, int], pace: Pace | None = None
) -> dict[Key, np.ndarray]:
    """Wall times (rounds * calls,) [ms] of each contender; each call is given another number.

    Args:
        contenders: what to call.
        threads: CPU threads of each; set before its calls, the process gets its own back at the end.
        pace: how long to measure.
    """
    pace = pace or Pace()
    order = np.random.default_rng(pace.seed)
    names, before = list(contenders), torch.get_num_threads()
    times: dict[Key, list[float]] = {name: [] for name in names}
    begin = time.perf_counter()
    try:
        for turn in range(pace.rounds):
            if turn >= pace.least and time.perf_counter() - begin > pace.budget_s:
                break
            # By threads, then shuffled: a team of threads is made anew at every change.
            for index in sorted(order.permutation(len(names)), key=lambda i: threads[names[i]]):
                name = names[index]
                if torch.get_num_threads() != threads[name]:
                    torch.set_num_threads(threads[name])
                _visit(contenders[name], times[name], turn, pace.calls)
    finally:
        torch.set_num_threads(before)
    return {name: np.array(values) for name, values in times.items()}


def _visit(call: Callable[[int], object], times: list[float], turn: int, calls: int) -> None:
    call(turn)
    for number in range(turn * calls, (turn + 1) * calls):
        synchronise()
        start = time.perf_counter()
        call(number)
        synchronise()
        times.append((time.perf_counter() - start) * 1e3)

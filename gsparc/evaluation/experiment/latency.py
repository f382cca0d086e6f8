"""Single-query latency of all methods of a problem, in turns, on one processor, after all training."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from gsparc.evaluation.experiment.problem import Problem
from gsparc.evaluation.experiment.run_cells import CellResult
from gsparc.models import loading
from gsparc.models.method import Method
from gsparc.prediction.timing import (
    COPY,
    ClockSettings,
    p50_p95,
    query_calls,
    reference_copy,
    time_interleaved,
)

log = logging.getLogger(__name__)

SLOW_MS = 200.0  # from here on a method would slow the rounds of the others: it has rounds of its own
ENDLESS_MS = 10_000.0  # from here on it is timed once
# 60 rounds give a 95th percentile from three samples beyond it.
FAST = ClockSettings(rounds=60, rounds_s=30.0)
SLOW = ClockSettings(rounds=5, least=1, warmup=0, rounds_s=20.0)
ONCE = replace(SLOW, rounds=1)


SPEED = ["query_ms", "query_p95_ms", "to_copy"]  # the last in units of a 16 MiB copy of the same rounds
TIMED = ["dataset", "split", "method", *SPEED]


def time_queries(filled: Sequence[CellResult], problem: Problem) -> dict[str, dict[str, float]]:
    """Return `SPEED` and the number of `rounds` by method, of the first of its checkpoints."""
    methods: dict[str, Method] = {}
    for one in filled:
        if one.cell.method not in methods:
            # The first of a method's cells stands for all of its efforts and seeds.
            methods[one.cell.method] = loading.load(one.checkpoint)[0]
    calls = query_calls(methods, problem.data, problem.folds.folds[0].test)
    found: dict[str, dict[str, float]] = {}

    def timed(names: Iterable[str], clock: ClockSettings) -> None:
        times = time_interleaved({COPY: reference_copy(), **{name: calls[name] for name in names}}, clock)
        copy = float(np.median(times.pop(COPY)))
        for name, values in times.items():
            p50, p95 = p50_p95(values)
            found[name] = dict(zip(SPEED, (p50, p95, p50 / copy), strict=True)) | {"rounds": len(values)}

    # By speed, before any takes a share of the rounds; a first call may make what later ones keep.
    timed(calls, ONCE)
    timed([name for name, one in found.items() if SLOW_MS < one["query_ms"] <= ENDLESS_MS], ONCE)
    speeds = {name: one["query_ms"] for name, one in found.items()}
    timed([name for name, ms in speeds.items() if ms <= SLOW_MS], FAST)
    timed([name for name, ms in speeds.items() if SLOW_MS < ms <= ENDLESS_MS], SLOW)
    return {name: found[name] for name in methods}


def time_by_dataset(
    filled: Sequence[CellResult], problems: Mapping[tuple[str, str], Problem]
) -> pd.DataFrame:
    """Return columns `TIMED`, of the first split of each dataset that is there and keeps its models.

    Of that alone: models of fewer measurements answer faster.
    """
    rows = []
    for dataset in dict.fromkeys(one.cell.dataset for one in filled):
        here = [one for one in filled if one.cell.dataset == dataset]
        split = here[0].cell.split
        present = [one for one in here if one.cell.split == split and one.checkpoint.exists()]
        if present:
            log.info("%s: timing single queries of every method in turns", dataset)
            where, found = (
                {"dataset": dataset, "split": split},
                time_queries(present, problems[dataset, split]),
            )
            rows += [{**where, "method": name, **one} for name, one in found.items()]
    return pd.DataFrame(rows, columns=TIMED)

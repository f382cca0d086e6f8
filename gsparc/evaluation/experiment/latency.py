"""Single-query latency of all methods of a problem, in turns, on one processor, after all training."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.experiment.problem import Problem
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


def time_queries(
    files: Mapping[str, Path], data: Measurements, split: Split, fast: ClockSettings = FAST
) -> dict[str, dict[str, float]]:
    """Return `SPEED` and the number of `rounds` of models by name; slow ones have clocks of their own."""
    methods: dict[str, Method] = {name: loading.load(file)[0] for name, file in files.items()}
    calls = query_calls(methods, data, split.folds[0].test)
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
    timed([name for name, ms in speeds.items() if ms <= SLOW_MS], fast)
    timed([name for name, ms in speeds.items() if SLOW_MS < ms <= ENDLESS_MS], SLOW)
    return {name: found[name] for name in methods}


def time_by_dataset(filled: pd.DataFrame, problems: Mapping[tuple[str, str], Problem]) -> pd.DataFrame:
    """Return columns `TIMED`, of the first split of each dataset that is there and keeps its models.

    Of that alone: models of fewer measurements answer faster. `filled` is the frame of `run_jobs`.
    """
    rows = []
    for dataset, here in filled.groupby("dataset", sort=False):
        split = str(here.split.iloc[0])
        # The first of a method's cells stands for all of its efforts and seeds.
        own = here[(here.split == split) & here.run.map(lambda run: bool(run.checkpoints))]
        files = own.drop_duplicates("method").set_index("method").run.map(lambda run: run.checkpoints[0])
        if len(files):
            log.info("%s: timing single queries of every method in turns", dataset)
            problem = problems[str(dataset), split]
            found = time_queries(files.to_dict(), problem.data, problem.folds)
            where = {"dataset": dataset, "split": split}
            rows += [{**where, "method": name, **one} for name, one in found.items()]
    return pd.DataFrame(rows, columns=TIMED)

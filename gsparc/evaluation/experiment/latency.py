"""Latency of single queries: models asked in turns, with nothing beside them, after all training."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd
import torch

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.open_runs import open_files
from gsparc.evaluation.results import frame_of_runs, own_rows, read_run
from gsparc.evaluation.scores import rows_to_score
from gsparc.evaluation.summary import write_samples
from gsparc.models import loading
from gsparc.models.method import Method
from gsparc.prediction.timing import (
    BLOCKS,
    SPEED,
    Call,
    ClockSettings,
    query_calls,
    time_beside_copy,
    time_interleaved,
)

log = logging.getLogger(__name__)

SLOW_MS = 200.0  # from here on a method would slow the rounds of the others: it has rounds of its own
ENDLESS_MS = 10_000.0  # from here on it is timed once
# 60 rounds give a 95th percentile from three samples beyond it.
FAST = ClockSettings(rounds=60, rounds_s=30.0)
SLOW = ClockSettings(rounds=5, least=1, warmup=0, rounds_s=20.0)
ONCE = replace(SLOW, rounds=1)


TIMED = ["dataset", "split", "method", *SPEED[:3]]


def time_queries(
    files: Mapping[str, Path], data: Measurements, split: Split, fast: ClockSettings = FAST
) -> dict[str, dict[str, float]]:
    """Return `SPEED` of models by name; slow ones have clocks of their own."""
    methods: dict[str, Method] = {name: loading.load(file)[0] for name, file in files.items()}
    calls = query_calls(methods, data, split.folds[0].test)
    found: dict[str, dict[str, float]] = {}

    def timed(names: Iterable[str], clock: ClockSettings) -> None:
        found.update(time_beside_copy({name: calls[name] for name in names}, clock))

    # By speed, before any takes a share of the rounds; a first call may make what later ones keep.
    timed(calls, ONCE)
    timed([name for name, one in found.items() if SLOW_MS < one["query_ms"] <= ENDLESS_MS], ONCE)
    speeds = {name: one["query_ms"] for name, one in found.items()}
    timed([name for name, ms in speeds.items() if ms <= SLOW_MS], fast)
    timed([name for name, ms in speeds.items() if SLOW_MS < ms <= ENDLESS_MS], SLOW)
    return {name: found[name] for name in methods}


def time_by_dataset(filled: pd.DataFrame) -> pd.DataFrame:
    """Return columns `TIMED`, of the first split of each dataset that is there and keeps its models.

    Of that alone: models of fewer measurements answer faster. `filled` is the frame of `run_jobs`.
    """
    rows = []
    for dataset, here in filled.groupby("dataset", sort=False):
        own = here[(here.split == here.split.iloc[0]) & here.run.map(lambda run: bool(run.checkpoints))]
        # The first of a method's cells stands for all of its efforts and seeds.
        first = own.drop_duplicates("method").set_index("method")
        if len(first):
            log.info("%s: timing single queries of every method in turns", dataset)
            files, job = first.run.map(lambda run: run.checkpoints[0]), first.job.iloc[0]
            found = time_queries(files.to_dict(), job.data, job.split)
            rows += [{**first.loc[name, TIMED[:2]], "method": name, **one} for name, one in found.items()]
    return pd.DataFrame(rows, columns=TIMED)


def time_again(rows: pd.DataFrame, *, rounds: int = 40, rounds_s: float = 60.0) -> pd.DataFrame:
    """Return the frame with the times of single queries, which each run's `render_ms.csv` has from now on.

    A sweep runs jobs at the same time, which disturbs their times; call this after it.

    Args:
        rows: those of runs without a readable checkpoint keep the times they have.
        rounds: visits to each.
        rounds_s: no new round after this [s].
    """
    runs, calls, threads = list(own_rows(rows).run), dict[int, Call](), dict[int, int]()
    for number, run in enumerate(runs):
        try:
            opened = open_files(run.checkpoints[:1])
            # A folder used twice may hold the model of one run beside the summary of the other.
            if opened.stored[0].extra.get("run_id") != run.facts.get("run_id"):
                raise ValueError("its checkpoint is of another run than its summary")
            tested = rows_to_score(opened.split.folds[0], "test")
        except (ValueError, IndexError) as error:
            log.warning("%s is not timed again: %s", run.folder, error or "it left no checkpoint")
            continue
        calls[number] = opened.predictor.cycle_places(opened.data.moving[tested])
        threads[number] = int(run.facts.get("machine/threads") or torch.get_num_threads())
    times = time_interleaved(calls, replace(BLOCKS, rounds=rounds, rounds_s=rounds_s), threads)
    for number, ms in times.items():
        write_samples(runs[number].folder / "render_ms.csv", {"render_ms": ms})
    return frame_of_runs(read_run(run.folder) for run in runs)

"""Models of runs timed again, in turns with one another."""

from __future__ import annotations

import logging
from dataclasses import replace

import pandas as pd
import torch

from gsparc.evaluation.open_runs import open_files
from gsparc.evaluation.results import frame_of_runs, own_rows, read_run
from gsparc.evaluation.summary import write_samples
from gsparc.prediction.timing import BLOCKS, Call, time_interleaved

log = logging.getLogger(__name__)


def time_again(rows: pd.DataFrame, *, rounds: int = 40, rounds_s: float = 60.0) -> pd.DataFrame:
    """Return the frame with the times of single queries, which each run's `render_ms.csv` has from now on.

    A sweep runs jobs at the same time, which disturbs their times; call this after it.

    Args:
        rows: those of runs without a readable checkpoint keep the times they have.
        rounds: visits to each.
        rounds_s: no new round after this [s].
    """
    runs, calls = list(own_rows(rows).run), dict[int, Call]()
    for number, run in enumerate(runs):
        try:
            opened = open_files(run.checkpoints[:1])
            # A folder used twice may hold the model of one run beside the summary of the other.
            if opened.stored[0].extra.get("run_id") != run.facts.get("run_id"):
                raise ValueError("its checkpoint is of another run than its summary")
            if not len(opened.split.folds[0].test):
                log.warning("%s is not timed again: it has no test rows", run.folder)
                continue
        except (ValueError, IndexError) as error:
            log.warning("%s is not timed again: %s", run.folder, error or "it left no checkpoint")
            continue
        calls[number] = opened.predictor.cycle_places(opened.data.moving[opened.split.folds[0].test])
    threads = {
        number: int(runs[number].facts.get("machine/threads") or torch.get_num_threads()) for number in calls
    }
    times = time_interleaved(calls, replace(BLOCKS, rounds=rounds, rounds_s=rounds_s), threads)
    for number, ms in times.items():
        write_samples(runs[number].folder / "render_ms.csv", {"render_ms": ms})
    return frame_of_runs(read_run(run.folder) for run in runs)

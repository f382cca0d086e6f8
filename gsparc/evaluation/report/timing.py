"""Latencies of the models of several runs, taken again: alone, in turns, on the same queries."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import torch

from gsparc.evaluation.open_runs import open_files
from gsparc.evaluation.report.runs import Run
from gsparc.evaluation.summary import write_samples
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import BLOCKS, Call, interleaved

log = logging.getLogger(__name__)


def retime(runs: Sequence[Run], *, rounds: int = 40, budget_s: float = 60.0) -> list[Run]:
    """The runs with the times of single queries, each also written to its `render_ms.csv`.

    A sweep runs jobs at the same time, which disturbs their times; call this after it.

    Args:
        runs: those without a readable checkpoint keep the times they have.
        rounds: visits to each.
        budget_s: no new round after this [s].
    """
    calls: dict[int, Call] = {}
    for number, run in enumerate(runs):
        try:
            opened = open_files(run.checkpoints[:1])
        except (ValueError, IndexError) as error:
            log.warning("%s is not timed again: %s", run.folder, error or "it left no checkpoint")
            continue
        places = opened.data.moving[opened.split.folds[0].test] + opened.data.site.origin
        calls[number] = Predictor(opened.methods[0], opened.data.site).cycling(places)
    threads = {
        number: int(runs[number].facts.get("machine/threads") or torch.get_num_threads()) for number in calls
    }
    times = interleaved(calls, replace(BLOCKS, rounds=rounds, budget_s=budget_s), threads)
    for number, ms in times.items():
        write_samples(runs[number].folder / "render_ms.csv", {"render_ms": ms})
    return [replace(run, render_ms=times[i]) if i in times else run for i, run in enumerate(runs)]

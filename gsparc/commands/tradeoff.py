"""`gsparc tradeoff ckpt=FILE`: accuracy against latency; the front is kept with the model."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig

from gsparc.base.limits import whole
from gsparc.evaluation.table import Column, Table
from gsparc.models.reduced import list_settings, with_reduction
from gsparc.pictures.drawing import save
from gsparc.pictures.plots import draw_front
from gsparc.prediction import operating_point
from gsparc.prediction.timing import BLOCKS, peak_memory
from gsparc.runs.experiment import tradeoff
from gsparc.runs.ledger import FitInputs, measurements_hash, run_once
from gsparc.runs.open_runs import Opened, open_run
from gsparc.runs.output import Result, in_multirun, run_directory
from gsparc.runs.run_lock import locked
from gsparc.runs.settings import to_dict
from gsparc.training import tracking

log = logging.getLogger(__name__)


def task(config: DictConfig) -> dict[str, Any]:
    """Sweep a checkpoint; return the facts of `summary.json`. A job of a multirun is done once."""
    run_dir = run_directory()
    run = open_run(config.ckpt, to_dict(config.dataset)).read(to_dict(config.split))
    state = FitInputs.from_config(config, measurements_hash(run.data), run.split.sha256)
    # The front is stored in the file itself, which changes it
    trained = run.stored[0].extra.get("run_id")
    state = replace(state, files=state.files | ({"ckpt": trained} if trained else {}))
    with locked(run_dir / ".job"):
        return run_once(
            run_dir, state, lambda left: _swept(config, run, run_dir), again=not in_multirun()
        )


def _swept(config: DictConfig, run: Opened, run_dir: Path) -> None:
    """Measure, draw and write."""
    data, method = run.data, run.methods[0]
    # What each component contributes is measured on rows that were learned from:
    # test rows choose nothing.
    learned = np.sort(run.split.folds[0].learned())
    inputs = method.reduction_inputs(data, learned)
    settings = list(list_settings(method, to_dict(config.grid)))
    single = config.threads is None and not method.threads_pay
    threads = [1] if single else _threads(config.threads)
    log.info("%d combinations, %s threads", len(settings), " and ".join(map(str, threads)))
    candidates = [(some, with_reduction(method, some, inputs)) for some in settings]
    clock = replace(BLOCKS, rounds=config.rounds, rounds_s=config.rounds_s)
    points, beside = tradeoff.measure_points(
        candidates, threads, config.baselines, data, run.split, config.eval_on, clock
    )
    model_points = points[points.kept_with_model == 1]
    if config.store:
        operating_point.store_points(Path(config.ckpt), model_points.to_dict("records"), inputs)
    title = f"{data.site.name}, split {run.split.title}, {config.eval_on}: {method.name}"
    save(draw_front(points, beside, method.name, title), run_dir / "tradeoff.png")
    facts = {
        **tradeoff.facts_of(points, beside),
        **peak_memory(),
        **run.facts(),
        "ckpt": str(config.ckpt),
        "seed": run.stored[0].configuration.get("seed"),
        "time/includes": "one query end to end: world position in, physical units out; warm",
        "tradeoff/stored": len(model_points) if config.store else 0,
    }
    best = points[points.front == 1].to_dict("records")
    sheet = Table.from_rows(title, [*tradeoff.POINT, Column(best[0]["figure"], of="value")], best)
    with tracking.open_loggers(config) as loggers:
        tracking.log_picture(loggers, "operating points", run_dir / "tradeoff.png")
        tracking.log_table(loggers, "operating points", *sheet.texts())
    columns = points.drop(columns=tradeoff.MADE).to_dict("list")
    lines, files = tradeoff.why_irreducible(method), {"tradeoff.csv": columns}
    Result(facts, [sheet], lines, columns=files).show(run_dir)
    # A front of one model's points alone would hide that another method is as fast and better.
    for row in best:
        if other := tradeoff.find_better(row, beside):
            log.warning("%s: %s is as fast and better", row["label"], other)


def _threads(setting: Sequence[int] | None) -> list[int]:
    # Small queries are mostly fastest on one thread, large batches on all.
    counts = (
        sorted({1, torch.get_num_threads()})
        if setting is None
        else sorted({int(n) for n in setting})
    )
    for count in counts or [0]:  # at most the cores of this machine
        whole(1, os.cpu_count()).check("threads", count)
    return counts

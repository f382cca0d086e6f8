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

from gsparc.commands.output import run_directory, show
from gsparc.commands.settings import plain
from gsparc.data.files import platform_cache
from gsparc.evaluation.drawing import save
from gsparc.evaluation.experiment.tradeoff import (
    Other,
    beaten_by,
    cells_of,
    columns_of,
    draw_front,
    facts_of,
    others_of,
    sweep,
)
from gsparc.evaluation.metric_formats import DECIDING, score_of
from gsparc.evaluation.open_runs import open_files
from gsparc.evaluation.scores import rows_of
from gsparc.evaluation.summary import provenance, table, write_samples, write_summary
from gsparc.models.method import Method
from gsparc.models.pareto import front
from gsparc.models.per_station import PerStation
from gsparc.models.reduced import combinations, contributions, knobs, reduced
from gsparc.prediction import operating_point
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import BLOCKS, COPY, machine_facts, peak_memory, percentiles, reference_copy
from gsparc.training import tracking

log = logging.getLogger(__name__)


def task(config: DictConfig) -> dict[str, Any]:
    """What the command does; returns the facts it wrote to `summary.json` in the run directory."""
    run_dir = run_directory()
    run = open_files([config.ckpt], plain(config.dataset), plain(config.split))
    fold, data, method = run.split.folds[0], run.data, run.methods[0]
    rows = rows_of(fold, config.eval_on)
    learned = np.sort(np.concatenate([fold.train, fold.val]))
    measured = contributions(method, data, learned)
    settings = list(combinations(method, plain(config.grid), plain(config.singles)))
    alone = config.threads is None and not method.threads_pay
    threads = [1] if alone else _threads(config.threads)
    log.info("%d combinations, %s threads", len(settings), " and ".join(map(str, threads)))
    candidates = [(some, reduced(method, some, measured)) for some in settings]
    others = others_of(
        run, config.baselines, config.peers, config.ckpt, config.eval_on,
        platform_cache() if config.cache is None else Path(config.cache),
    )  # fmt: skip
    places = data.moving[rows] + data.site.origin
    clocks = {name: Predictor(other, data.site).cycling(places) for name, (other, _) in others.items()}
    clock = replace(BLOCKS, rounds=config.rounds, budget_s=config.budget_s)
    timed = {COPY: reference_copy(), **clocks}
    how = {"eval_on": config.eval_on, "clock": clock, "others": timed}
    points, other_ms = sweep(candidates, threads, data, fold, **how)
    figure = DECIDING[data.site.kind]
    shown = front([p.p50 for p in points], [score_of(figure, p.value(figure)) for p in points])
    chosen = front([p.p50 for p in points], [p.closeness_db for p in points])
    if config.store:
        operating_point.keep(Path(config.ckpt), [points[i] for i in chosen], figure, measured)
    beside = {
        name: Other(value, *percentiles(other_ms[name]))
        for name, (_, value) in others.items()
        if value is not None
    }
    copy_ms = float(np.median(other_ms[COPY]))
    write_samples(run_dir / "tradeoff.csv", columns_of(points, shown, chosen, copy_ms))
    best = [points[i] for i in shown]
    title = f"{data.site.name}, split {run.split.name}, {config.eval_on}: {method.name}"
    save(draw_front(points, shown, beside, figure, method.name, title), run_dir / "tradeoff.png")
    facts = {
        **facts_of(points, best, figure, beside, copy_ms),
        **machine_facts(), **peak_memory(), **provenance(), **run.facts(),
        "ckpt": str(config.ckpt),
        "seed": run.stored[0].configuration.get("seed"),
        "time/includes": "one query end to end: world position in, physical units out; warm",
        "tradeoff/stored": len(chosen) if config.store else 0,
    }  # fmt: skip
    write_summary(run_dir / "summary.json", facts)
    heads, lines = cells_of(best, figure)
    with tracking.opened(config.logger) as loggers:
        tracking.picture(loggers, "operating points", run_dir / "tradeoff.png", 0)
        tracking.table(loggers, "operating points", heads, lines)
    show(run_dir, table(title, ["not beaten"], heads[1:], lines), lines=[*_alone(method), *_slope(facts)])
    for p in best:
        other = beaten_by(p, beside, figure)
        if other is not None:
            log.warning("%s: %s is as fast and better", p.label, other)
    return facts


def _threads(given: Sequence[int] | None) -> list[int]:
    found = sorted({1, torch.get_num_threads()}) if given is None else sorted({int(n) for n in given})
    cores = os.cpu_count() or 1
    if found and found[0] >= 1 and found[-1] <= cores:
        return found
    raise ValueError(f"threads={found}: numbers between 1 and the {cores} cores of this machine are needed")


def _alone(method: Method) -> list[str]:
    """What is said where there is nothing to weigh against time."""
    if knobs(method):
        return []
    why = "it has no Gaussians, sources, components or variances to spare"
    if isinstance(method, PerStation):
        why = "one of several stations is asked as it was trained"
    return [f"{method.name}: nothing of it can be reduced, so that there is one point ({why})"]


def _slope(facts: dict[str, Any]) -> list[str]:
    names = ("front", "span", "per_halving", "front_beaten_by_others")
    count, span, slope, beaten = (facts[f"tradeoff/{name}"] for name in names)
    rest = f" ({count - beaten} that no baseline beats)" if beaten else ""
    text = (
        f"{count} points span {span:.1f} times in latency; each halving costs {slope or 0:.2g} dB on average"
    )
    return [] if slope is None else [f"{text} along the front{rest}"]

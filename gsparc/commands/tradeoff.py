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
from gsparc.data.splits import Split
from gsparc.evaluation.baseline_cache import baseline
from gsparc.evaluation.drawing import save
from gsparc.evaluation.experiment.tradeoff import Candidate, Other, beaten_by, draw_front, sweep
from gsparc.evaluation.figures import DECIDING, score_of
from gsparc.evaluation.open_runs import Opened, open_files, trained_on
from gsparc.evaluation.scores import rows_of, score
from gsparc.evaluation.summary import provenance, table, write_samples, write_summary
from gsparc.models import loading
from gsparc.models.method import Method
from gsparc.models.pareto import Point, cost_of_halving, front, worded
from gsparc.models.per_station import PerStation
from gsparc.models.reduced import combinations, contributions, knobs, reduced
from gsparc.prediction import operating_point
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import BLOCKS, COPY, machine_facts, peak_memory, reference_copy
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
    threads = _threads(config.threads)
    log.info("%d combinations, %s threads", len(settings), " and ".join(map(str, threads)))
    candidates = [Candidate(worded(s), s, reduced(method, s, measured), tuple(threads)) for s in settings]
    others = _others(config, run)
    places = data.moving[rows] + data.site.origin
    clocks = {name: Predictor(other, data.site).cycling(places) for name, (other, _) in others.items()}
    clock = replace(BLOCKS, rounds=config.rounds, budget_s=config.budget_s)
    timed = {COPY: reference_copy(), **clocks}
    points, other_ms = sweep(candidates, data, fold, eval_on=config.eval_on, clock=clock, others=timed)
    figure = DECIDING[data.site.kind]
    shown = front([p.p50 for p in points], [score_of(figure, p.value(figure)) for p in points])
    chosen = front([p.p50 for p in points], [p.closeness_db for p in points])
    if config.store:
        operating_point.keep(Path(config.ckpt), [points[i] for i in chosen], figure, measured)
    beside = {
        name: Other(value, float(np.median(other_ms[name])), float(np.quantile(other_ms[name], 0.95)))
        for name, (_, value) in others.items()
        if value is not None
    }
    copy_ms = float(np.median(other_ms[COPY]))
    write_samples(run_dir / "tradeoff.csv", _columns(points, shown, chosen, copy_ms))
    best = [points[i] for i in shown]
    title = f"{data.site.name}, split {run.split.name}, {config.eval_on}: {method.name}"
    save(draw_front(points, shown, beside, figure, method.name, title), run_dir / "tradeoff.png")
    facts = {
        **_facts(points, best, figure, beside, copy_ms),
        **machine_facts(), **peak_memory(), **provenance(), **run.facts(),
        "ckpt": str(config.ckpt),
        "seed": run.stored[0].configuration.get("seed"),
        "time/includes": "one query end to end: world position in, physical units out; warm",
        "tradeoff/stored": len(chosen) if config.store else 0,
    }  # fmt: skip
    write_summary(run_dir / "summary.json", facts)
    heads, lines = _cells(best, figure)
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


def _others(config: DictConfig, run: Opened) -> dict[str, tuple[Method, float | None]]:
    """Baselines and the methods in other checkpoints, with the deciding figure of each."""
    figure, data = DECIDING[run.data.site.kind], run.data
    whole = Split("tradeoff", (run.split.folds[0],), "")
    cache = platform_cache() if config.cache is None else Path(config.cache)
    found: dict[str, tuple[Method, float | None]] = {}
    for name in config.baselines:
        fitted = baseline(name, data, run.split, config.eval_on, cache)
        found[name] = (fitted.methods[0], fitted.scores.figures()[figure])
    for path in config.peers:
        method, other = loading.load(path)
        if trained_on([other], replace(run.split, folds=run.split.folds[:1])) is False:
            raise ValueError(f"peers: {path} was trained on another split than {config.ckpt}")
        names = (method.name, f"{method.name} ({Path(path).parent.name})", path)
        name = next(name for name in names if name not in found)
        found[name] = (method, score([method], data, whole, config.eval_on).figures()[figure])
    return found


def _columns(
    points: list[Point], shown: list[int], chosen: list[int], copy_ms: float
) -> dict[str, list[Any]]:
    """Columns of `tradeoff.csv`, fastest point first."""
    order = sorted(range(len(points)), key=lambda i: points[i].p50)
    rows = [points[i] for i in order]
    knobs = list(dict.fromkeys(knob for p in points for knob in p.settings))
    return {
        "label": [p.label for p in rows],
        "render_ms_p50": [p.p50 for p in rows],
        "render_ms_p95": [p.p95 for p in rows],
        "ratio_to_copy": [p.p50 / copy_ms for p in rows],
        **{figure: [p.figures[figure] for p in rows] for figure in points[0].figures},
        "difference_to_full": [p.difference[0] for p in rows],
        "difference_se": [p.difference[1] for p in rows],
        "closeness_db": [p.closeness_db for p in rows],
        "front": [int(i in shown) for i in order],
        "kept_with_model": [int(i in chosen) for i in order],
        "threads": [p.threads for p in rows],
        "num_gaussians": [p.size for p in rows],
        **{f"set/{knob}": [_cell(p.settings.get(knob)) for p in rows] for knob in knobs},
    }


def _cell(value: Any) -> Any:
    return "+".join(map(str, value)) if isinstance(value, (list, tuple)) else value


def _facts(
    points: list[Point], best: list[Point], figure: str, others: dict[str, Other], copy_ms: float
) -> dict[str, Any]:
    full = min((p for p in points if not p.settings), key=lambda p: p.p50)
    useful = [p for p in best if beaten_by(p, others, figure) is None]  # a slope of points that others beat
    halving = cost_of_halving([p.p50 for p in useful], [score_of(figure, p.value(figure)) for p in useful])
    facts: dict[str, Any] = {
        "tradeoff/points": len(points),
        "tradeoff/front": len(best),
        "tradeoff/span": best[-1].p50 / best[0].p50,
        "tradeoff/per_halving": halving,
        "tradeoff/figure": figure,
        "tradeoff/front_beaten_by_others": sum(beaten_by(p, others, figure) is not None for p in best),
        "time/copy_ms": copy_ms,
        "time/render_ms_p50": full.p50,
        "time/render_ms_p95": full.p95,
        f"test/{figure}": full.value(figure),
    }
    for number, p in enumerate(best, 1):
        own = {"render_ms_p50": p.p50, "render_ms_p95": p.p95, "label": p.label, **p.figures}
        facts |= {f"front/{number}/{name}": value for name, value in own.items()}
    for name, other in others.items():
        facts |= {f"baseline/{name}/{figure}": other.value, f"baseline/{name}/render_ms_p50": other.p50}
    return facts


def _cells(best: list[Point], figure: str) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of points."""
    rows = []
    for p in best:
        gap, error = p.difference
        apart = "-" if gap is None or error is None else f"{gap:+.3g} ± {error:.2g}"
        rows.append([p.label, f"{p.p50:.3g}", f"{p.p95:.3g}", f"{p.value(figure):.4g}", apart])
    return ["point", "ms p50", "ms p95", figure, "difference to full"], rows


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

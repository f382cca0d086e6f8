"""`gsparc calibrate ckpt=FILE`: compare confidences, promise an error, check the promise."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.table import Table

from gsparc.commands.output import run_directory, show
from gsparc.commands.settings import RunSettings, plain
from gsparc.evaluation.calibration import (
    How,
    Trial,
    collect,
    divisible,
    draw_calibration,
    figures,
    store,
    too_few,
    trials,
)
from gsparc.evaluation.summary import provenance, shown, table, write_summary
from gsparc.prediction.confidence import Evidence
from gsparc.prediction.risk_threshold import Promise
from gsparc.prediction.timing import machine_facts

log = logging.getLogger(__name__)


def task(config: DictConfig) -> dict[str, Any]:
    """Gather, resample, write; returns the facts of `summary.json`."""
    RunSettings.of(config)
    run_dir = run_directory()
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    settings = plain(config)
    evidence, known = collect(paths, settings["dataset"], settings["split"])
    if config.confidence != "auto" and config.confidence not in evidence.scores:
        raise ValueError(f"confidence={config.confidence}: expected auto or {', '.join(evidence.scores)}")
    promise = Promise(float(config.limit_db), float(config.alpha), float(config.delta))
    if not divisible(evidence, "spatial"):
        log.warning("the positions lie in too few patches of the plane: tried on random divisions alone")
    ways: tuple[How, ...] = ("random", "spatial") if divisible(evidence, "spatial") else ("random",)
    draws = int(config.draws), config.confidence, float(config.apart_m), int(config.seed)
    found = [trials(evidence, promise, how, *draws) for how in ways]
    facts = known | figures(evidence, found, promise) | machine_facts() | provenance()
    facts["seed"] = config.seed
    write_summary(run_dir / "summary.json", facts)
    draw_calibration(
        evidence, found, f"{known['dataset/name']}, {known['model/name']}", run_dir / "confidence.png"
    )
    few = too_few(len(evidence), promise)
    stored_lines = [] if few is None else [few]
    if config.store:
        how = promise, config.confidence, bool(config.spatial), int(config.seed)
        for path in paths:
            stored, bound = store(path, settings["dataset"], settings["split"], *how)
            threshold = stored.threshold if np.isfinite(stored.threshold) else None
            facts["stored/kind"], facts["stored/threshold"] = stored.kind, threshold
            stored_lines.append(f"{path}: confidence={stored.kind}, {bound}")
        write_summary(run_dir / "summary.json", facts)
    show(run_dir, *tables(facts, evidence, found), lines=stored_lines)
    return facts


def tables(facts: dict[str, Any], evidence: Evidence, found: list[Trial]) -> list[Table]:
    """Confidences side by side; bounds beside what came of them."""
    wanted = {
        "area under risk-coverage": ("area", ".4g"), "below distance": ("area_below_distance", ".0%"),
        "risk at 70 %": ("risk_at_70", ".4g"), "rank": ("rank_correlation", ".2f"),
    }  # fmt: skip
    curves = [
        [kind, *(shown(facts[f"confidence/{kind}/{key}"], form) for key, form in wanted.values())]
        for kind in evidence.scores
    ]
    draws = []
    for trial in found:
        low, high = trial.interval or (0.0, 0.0)
        broken = "-" if trial.broken is None else f"{trial.broken:.1%}, {low:.0%} to {high:.0%}"
        draws.append([
            trial.how, trial.kind, f"{trial.coverage.mean():.0%}", shown(trial.mean_realised, ".1%"),
            broken, f"{trial.broken_of_all:.1%}", f"{trial.delta:.0%}", f"{trial.silent:.0%}",
        ])  # fmt: skip
    numbers = ["accepted", "bad among them", "broken", "of all draws", "promised", "accepted nobody"]
    heading = f"{facts['dataset/name']}: {len(evidence)} positions of {facts['model/name']}"
    promise = f"at most {facts['promise/alpha']:.0%} worse than {facts['promise/limit_db']:g} dB"
    return [
        table(heading, ["confidence"], list(wanted), curves),
        table(promise, ["split", "confidence"], numbers, draws),
    ]

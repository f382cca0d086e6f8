"""`gsparc calibrate ckpt=FILE`: compare confidences, promise an error, check the promise."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.table import Table

from gsparc.commands.output import run_directory, show
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.campaigns.argos import published_figures, published_normalisation
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.evaluation.calibration import (
    MOST_LAX_DB,
    How,
    Trial,
    accept,
    bounded,
    divisible,
    draw_calibration,
    laxer,
    perfect_area,
    rank_correlation,
    risk_coverage,
    too_few,
    trials,
)
from gsparc.evaluation.open_runs import Opened, open_files
from gsparc.evaluation.scores import rows_of
from gsparc.evaluation.summary import provenance, shown, table, write_summary
from gsparc.models.method import Method
from gsparc.prediction.confidence import (
    CHUNK,
    Evidence,
    Trusted,
    gather,
    joined,
    keep,
    known_positions,
    position_kernel,
    threshold_of,
)
from gsparc.prediction.risk_threshold import Promise
from gsparc.prediction.timing import machine_facts

log = logging.getLogger(__name__)


def collect(
    paths: list[str], dataset: dict[str, Any], split: dict[str, Any]
) -> tuple[Evidence, dict[str, Any]]:
    """Evidence of every checkpoint's own test rows, and the facts that name them; no row twice."""
    parts, seen = [], np.zeros(0, np.int64)
    facts: dict[str, Any] = {}
    for path in paths:
        run = _unseen(path, dataset, split)
        fold = run.split.folds[0]
        rows = np.setdiff1d(rows_of(fold, "test"), seen)
        if len(rows):
            parts.append(gather(run.methods[0], run.data, fold, rows))
        seen = np.concatenate([seen, rows])
        facts = facts or _published(run.methods[0], run.data, fold) | run.facts()
    return joined(parts), facts


def store(
    path: str,
    dataset: dict[str, Any],
    split: dict[str, Any],
    promise: Promise,
    kind: str,
    spatial: bool,
    seed: int,
) -> tuple[Trusted, str]:
    """Choose and calibrate on the checkpoint's own test rows, and keep it with the model; and how it went."""
    run = _unseen(path, dataset, split)
    method, data, fold = run.methods[0], run.data, run.split.folds[0]
    evidence = gather(method, data, fold, rows_of(fold, "test"))
    used, found, _, _ = accept(evidence, promise, kind, spatial, seed)
    threshold = threshold_of(used, found)
    stored = Trusted(used, threshold, promise, known_positions(data, fold), position_kernel(data, fold))
    keep(path, stored)
    if np.isfinite(threshold):
        return stored, f"accepted from {threshold:.4g}"
    if too_few(len(evidence), promise) is not None:
        return stored, "no threshold keeps the bound"
    bad, limit = promise.bad(evidence.error).mean(), f"{promise.limit_db:g} dB"
    other = laxer(evidence, promise, kind, spatial, seed)
    hint = (
        f"no limit_db= up to {MOST_LAX_DB} is" if other is None else f"limit_db={other.limit_db:g} would be"
    )
    return stored, (
        f"no threshold keeps the bound: {bad:.0%} of {len(evidence)} test positions are worse than {limit}, "
        f"and the others are not told from them surely enough; {hint} kept, more training rows may help"
    )


def _unseen(path: str, dataset: dict[str, Any], split: dict[str, Any]) -> Opened:
    """A checkpoint with test rows that it has not learned from: on others no promise would hold."""
    run = open_files([path], dataset, split)
    if run.learned != 0:
        advice = "calibrate with the data and split of its training"
        raise ValueError(f"{path} was trained on {run.foreign}; {advice}")
    return run


def _published(method: Method, data: Measurements, fold: Fold) -> dict[str, float]:
    """`peers/*` and `denormalised/*` of Argos data: the figures under both normalisations, all test rows."""
    if data.uplink is None:
        return {}
    batches = (data.batch(fold.test[i : i + CHUNK]) for i in range(0, len(fold.test), CHUNK))
    predicted = np.concatenate([method.answer(batch).mean.numpy() for batch in batches])
    target = data.target[fold.test]
    both = {"peers": published_normalisation(data.target, fold.train), "denormalised": (0j, 1.0)}
    found = {room: published_figures(predicted, target, *removed) for room, removed in both.items()}
    return {f"{room}/{name}": value for room, one in found.items() for name, value in one.items()}


def figures(evidence: Evidence, found: list[Trial], promise: Promise) -> dict[str, Any]:
    """Flat figures: `confidence/<kind>/*`, `promise/*`, `trial/<how>/*`."""
    loss = bounded(evidence.error)
    facts: dict[str, Any] = {"positions": len(evidence), "confidence/perfect/area": perfect_area(loss)}
    curves = {kind: risk_coverage(score, loss) for kind, score in evidence.scores.items()}
    bar = curves["distance"].area
    for kind, curve in curves.items():
        own = {
            "area": curve.area, "risk_at_70": curve.at(0.7),
            "rank_correlation": rank_correlation(evidence.scores[kind], loss),
            "area_below_distance": 1 - curve.area / bar if bar > 0 else None,  # nothing to save
        }  # fmt: skip
        facts |= {f"confidence/{kind}/{name}": value for name, value in own.items()}
    facts |= {f"promise/{name}": value for name, value in vars(promise).items()}
    for trial in found:
        low, high = trial.interval or (None, None)
        came = {
            "kind": trial.kind, "broken": trial.broken, "broken_low": low, "broken_high": high,
            "broken_of_all": trial.broken_of_all, "silent": trial.silent, "realised": trial.mean_realised,
            "coverage": float(trial.coverage.mean()), "draws": len(trial.realised),
        }  # fmt: skip
        facts |= {f"trial/{trial.how}/{name}": value for name, value in came.items()}
    return facts


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

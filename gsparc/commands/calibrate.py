"""`gsparc calibrate ckpt=FILE`: compare confidences, promise an error, check the promise."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.table import Table

from gsparc.commands.shared.output import run_directory, show
from gsparc.commands.shared.settings import RunSettings, plain
from gsparc.evaluation.open_runs import collect, store
from gsparc.evaluation.pictures import NAMES, draw_calibration
from gsparc.evaluation.summary import provenance, shown, table, write_summary
from gsparc.prediction.risk import Guarantee, figures, too_few, trials
from gsparc.prediction.timing import machine_facts

log = logging.getLogger(__name__)


def task(config: DictConfig) -> dict[str, Any]:
    """Gather, resample, write; returns the facts of `summary.json`."""
    RunSettings.of(config)
    run_dir = run_directory()
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    settings = plain(config)
    evidence, known = collect(paths, settings["dataset"], settings["split"])
    # Refused here, before hundreds of draws would fail in the same way.
    if config.confidence != "auto" and config.confidence not in evidence.scores:
        raise ValueError(f"confidence={config.confidence}: expected auto or {', '.join(evidence.scores)}")
    promise = Guarantee(float(config.limit_db), float(config.alpha), float(config.delta))
    draws = int(config.draws), config.confidence, float(config.apart_m), int(config.seed)
    divisions = [trials(evidence, promise, "random", *draws)]
    try:
        divisions.append(trials(evidence, promise, "spatial", *draws))
    except ValueError:
        # With fewer patches than parts no division by whole cells exists.
        log.warning("the positions lie in too few patches of the plane: tried on random divisions alone")
    facts = known | figures(evidence, divisions, promise) | machine_facts() | provenance()
    facts["seed"] = config.seed
    # Written before a threshold is stored: where storing fails, these figures are there.
    write_summary(run_dir / "summary.json", facts)
    title = f"{known['dataset/name']}, {known['model/name']}"
    draw_calibration(evidence, divisions, promise, title, run_dir / "confidence.png")
    few = too_few(len(evidence), promise)
    stored_lines = [] if few is None else [few]
    if config.store:
        how = promise, config.confidence, bool(config.spatial), int(config.seed)
        for path in paths:
            stored, bound = store(path, settings["dataset"], settings["split"], *how)
            # An infinite threshold accepts nobody, and JSON has no infinity.
            threshold = stored.threshold if np.isfinite(stored.threshold) else None
            facts["stored/kind"], facts["stored/threshold"] = stored.kind, threshold
            stored_lines.append(f"{path}: {bound}")
        write_summary(run_dir / "summary.json", facts)
    show(run_dir, *tables(facts), lines=stored_lines)
    return facts


def tables(facts: dict[str, Any]) -> list[Table]:
    """Return tables of confidences side by side, and of bounds beside what came of them."""
    wanted = {
        "area under risk-coverage": ("area", ".4g"), "below distance": ("area_below_distance", ".0%"),
        "risk at 70 %": ("risk_at_70", ".4g"), "rank": ("rank_correlation", ".2f"),
    }  # fmt: skip
    curves = [
        [kind, *(shown(facts[f"confidence/{kind}/{key}"], form) for key, form in wanted.values())]
        for kind in NAMES
        if f"confidence/{kind}/area" in facts
    ]
    draws = []
    for how in ("random", "spatial"):
        # Spatial draws were left out where the patches were too few.
        if f"trial/{how}/kind" not in facts:
            continue
        own = {key.rpartition("/")[2]: value for key, value in facts.items() if f"trial/{how}/" in key}
        ends = f"{own['broken_low'] or 0:.0%} to {own['broken_high'] or 0:.0%}"
        broken = "-" if own["broken"] is None else f"{own['broken']:.1%}, {ends}"
        draws.append([
            how, own["kind"], f"{own['coverage']:.0%}", shown(own["realised"], ".1%"), broken,
            f"{own['broken_of_all']:.1%}", f"{facts['promise/delta']:.0%}", f"{own['silent']:.0%}",
        ])  # fmt: skip
    numbers = ["accepted", "bad among them", "broken", "of all draws", "promised", "accepted nobody"]
    heading = f"{facts['dataset/name']}: {facts['positions']} positions of {facts['model/name']}"
    promise = f"at most {facts['promise/alpha']:.0%} worse than {facts['promise/limit_db']:g} dB"
    return [
        table(heading, ["confidence"], list(wanted), curves),
        table(promise, ["split", "confidence"], numbers, draws),
    ]

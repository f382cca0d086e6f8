"""`gsparc calibrate ckpt=FILE`: a confidence, what it promises, and a check of the promise."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from gsparc.evaluation.results import facts_under
from gsparc.evaluation.summary import write_summary
from gsparc.evaluation.table import Column, Interval, Table
from gsparc.pictures.pictures import NAMES, draw_calibration
from gsparc.prediction.confidence import Guarantee
from gsparc.prediction.left_out import Evidence
from gsparc.prediction.risk import SHARES, calibration_facts, explain_too_few, run_trials
from gsparc.runs.output import CommandCall, Result, command
from gsparc.runs.unseen import Unseen

log = logging.getLogger(__name__)


@command()
def task(call: CommandCall) -> Result:
    """Gather, resample, write."""
    config, given = call.config, call.given
    opened = [Unseen.open(path, given["dataset"], given["split"]) for path in call.paths]
    evidence, run_facts = Evidence.join([unseen.evidence for unseen in opened]), opened[0].facts
    promise = Guarantee(float(config.limit_db), float(config.alpha), float(config.delta))
    draws = int(config.draws), config.confidence, int(config.seed)
    divisions = [run_trials(evidence, promise, False, *draws)]
    try:
        divisions.append(run_trials(evidence, promise, True, *draws))
    except ValueError:
        # With fewer patches than parts no division by whole cells exists.
        log.warning(
            "the positions lie in too few patches of the plane: tried on random divisions alone"
        )
    facts = run_facts | calibration_facts(evidence, divisions, promise) | {"seed": config.seed}
    # Written before a threshold is stored: where storing fails, these figures are there.
    write_summary(call.folder / "summary.json", facts)
    title = f"{run_facts['dataset/name']}, {run_facts['model/name']}"
    draw_calibration(evidence, divisions, promise, title, call.folder / "confidence.png")
    few = explain_too_few(len(evidence), promise)
    stored_lines = [] if few is None or config.store else [few]
    if config.store:
        trial = divisions[-1 if config.spatial else 0].summarise()
        surely = trial["broken_low"] is not None and trial["broken_low"] > promise.delta
        for unseen in opened:
            stored, bound = unseen.calibrate_and_store(
                promise,
                config.confidence,
                bool(config.spatial),
                int(config.seed),
                trial["broken"] if surely else None,
            )
            # An infinite threshold accepts nobody, and JSON has no infinity.
            threshold = stored.threshold if np.isfinite(stored.threshold) else None
            facts["stored/kind"], facts["stored/threshold"] = stored.kind, threshold
            # The confidence first, then what is promised of it: a line each.
            stored_lines += [f"{unseen.path}: {part}" for part in bound.split("; ", 1)]
    return Result(facts, calibration_tables(facts), stored_lines)


def calibration_tables(facts: dict[str, Any]) -> list[Table]:
    """Return tables of confidences side by side, and of bounds beside what came of them."""
    curves = [
        Column("confidence", "", of="kind"),
        Column("area under risk-coverage", of="area"),
        Column("mean error of the surest 70 %", of="risk_at_70"),
        Column("rank correlation", ".2f", of="rank_correlation"),
    ]
    kinds = [{"kind": kind, **facts_under(facts, f"confidence/{kind}")} for kind in NAMES]
    draws = [
        Column("rows divided", "", of="how"),
        Column("confidence", "", of="kind"),
        Column("answers accepted", ".0%", of="coverage"),
        Column("bad among them", ".1%", of="realised"),
        Column("trials accepting none", ".0%", of="silent"),
        Column("failed, of all trials", ".1%", of="broken_of_all"),
        Column("promised: at most", ".0%", of=lambda row: facts["promise/delta"]),
        Column("failed, of accepting trials: no promise", ".1%", of=_broken),
    ]
    # Spatial draws are left out where the patches are too few.
    trials_of = [
        {"how": how, **facts_under(facts, f"trial/{how}")} for how in ("random", "spatial")
    ]
    of = f"{facts['dataset/name']}, {facts['positions']} test positions of {facts['model/name']}"
    heading = f"{of}: which confidence orders errors best (a smaller area is better)"
    bad = f"bad (an error above {facts['promise/limit_db']:g} dB)"
    trials = "Trials, each with a threshold from some rows and a test on others"
    promise = (
        f"{trials}; one fails if more than {facts['promise/alpha']:.0%} of accepted "
        f"answers are {bad}"
    )
    note = (
        f"Trials calibrate on {SHARES[1]:.0%} of the rows, the stored threshold on "
        f"{1 - SHARES[0]:.0%}"
    )
    return [
        Table.from_rows(heading, curves, [row for row in kinds if "area" in row]),
        Table.from_rows(promise, draws, [row for row in trials_of if "coverage" in row], note=note),
    ]


def _broken(row: Mapping[str, Any]) -> Interval | None:
    return (
        None
        if row["broken"] is None
        else Interval(row["broken"], row["broken_low"], row["broken_high"])
    )

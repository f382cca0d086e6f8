"""Gain and cost of each effect, paired by sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np

from gsparc.evaluation.figures import PER_SAMPLE, heading_of
from gsparc.evaluation.report.intervals import Interval
from gsparc.evaluation.report.runs import Run, number, sizes
from gsparc.evaluation.report.table import Column, Table


def effects(runs: Sequence[Run]) -> Table | None:
    """Gain and cost of each effect: paired differences between runs of one split; None without pairs."""
    name = PER_SAMPLE[runs[0].kind]
    table = Table(
        "Effects: gain and cost",
        [
            Column("effect"), Column("without"), Column("with"),
            Column(f"{heading_of(name)} gained", "+.2f"),
            Column("train s more", "+.3g"), Column("query ms more", "+.3g"),
        ],
        note="Differences per test sample, mean and 95 % interval; same seed, same split.",
    )  # fmt: skip
    for off, on in product(runs, runs):
        if _differ_by_effect(off, on):
            costs = [(number(run.facts.get("time/train_s")), run.latency[0]) for run in (off, on)]
            spent = [None if a is None or b is None else b - a for a, b in zip(*costs, strict=True)]
            table.add(on.facts.get("model/effects"), off.setting, on.setting, _paired(off, on, name), *spent)
    return table if table.rows else None


def _differ_by_effect(off: Run, on: Run) -> bool:
    names = ("dataset/sha256", "split/sha256", "seed", "model/name")
    same = all(off.facts.get(name) == on.facts.get(name) for name in names)
    plain = (off.facts.get("model/effects") or "none") == "none"
    return same and plain and (on.facts.get("model/effects") or "none") != "none"


def _paired(off: Run, on: Run, name: str) -> Interval | None:
    """Mean difference per sample in dB, larger is better."""
    if name not in off.samples or name not in on.samples or len(off.samples[name]) != len(on.samples[name]):
        return None
    gap = (-1 if name == "error_db" else 1) * (sizes(on, name) - sizes(off, name))
    gap = gap[np.isfinite(gap)]
    half = 1.96 * float(gap.std(ddof=1)) / math.sqrt(len(gap)) if len(gap) > 1 else math.nan
    return Interval(float(gap.mean()), float(gap.mean()) - half, float(gap.mean()) + half)

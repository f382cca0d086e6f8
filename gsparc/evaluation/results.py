"""Results as one table: a row a data set, split, fold, seed and method, columns its figures and seconds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsparc.evaluation.metric_formats import DECIDING, main_figure, score_of

# Columns by the facts of a summary that they hold: of the run, of its own method, of any method.
OF_RUN = {
    "dataset": "dataset/name", "split": "split/name", "seed": "seed", "kind": "dataset/kind",
    "load": "machine/load", "data": "dataset/sha256", "git": "git", "simulate_s": "dataset/simulate_s",
    "rows": "split/sha256",
}  # fmt: skip
OF_MODEL = {
    "label": "model/label", "gaussians": "model/num_gaussians", "memory_mb": "memory/peak_mb",
}  # fmt: skip
COSTS = {
    "train_s": "train_s", "train_cpu_s": "train_cpu_s", "query_ms": "render_ms_p50",
    "query_p95_ms": "render_ms_p95", "batch_ms": "render_ms_batch64",
}  # fmt: skip


def facts_under(facts: Mapping[str, Any], room: str) -> dict[str, Any]:
    """Return the facts whose names begin with `room/`, without it."""
    stem = f"{room}/"
    return {name[len(stem) :]: value for name, value in facts.items() if name.startswith(stem)}


def result_rows(facts: Mapping[str, Any], prefix: str = "test") -> list[dict[str, Any]]:
    """Return the row of a run's method and those of the baselines beside it, from the facts of its summary.

    Figures are of rows `prefix`: `test`, `train` or `val`. Columns are those of `OF_RUN`, `OF_MODEL` and
    `COSTS`; `draw` of its test rows, `fold` (None: all are pooled), `method`, `baseline` (whether it is one),
    `measured` (rows that a model learned from), `effects`, `figure` (the deciding one), its `value`, that of
    Gaussians `alone`, and every figure under its own name; None where a summary has no such fact.
    """
    # Counts of a summary are sums over folds; `measured` is per model.
    counts = [int(facts.get(f"split/{name}") or 0) for name in ("train", "val", "folds")]
    folds = max(counts[2], 1)
    shared: dict[str, Any] = {name: facts.get(key) for name, key in OF_RUN.items()}
    # Test rows alone: a seed may move those of validation only. Older summaries have one hash of all.
    shared["draw"] = str(facts.get("split/test_sha256", facts.get("split/sha256")))[:8]
    shared["kind"] = shared["kind"] if shared["kind"] in DECIDING else "spectrum"
    shared |= {"fold": 0 if folds == 1 else None, "figure": main_figure(facts, prefix), "alone": None}
    shared |= {"measured": sum(counts[:2]) // folds, "effects": "none"}
    own = {name: facts.get(key) for name, key in OF_MODEL.items()}
    model = own | {"effects": facts.get("model/effects") or "none"}
    model["alone"] = facts.get(f"field/{shared['figure']}")
    name = str(facts.get("model/name", "?"))
    rows = [shared | model | row_of_method(name, facts_under(facts, prefix), facts_under(facts, "time"))]
    # dict.fromkeys: a set of names would forget the order that the summary has them in.
    beside = dict.fromkeys(name.split("/")[1] for name in facts if name.startswith("baseline/"))
    every = ((name, facts_under(facts, f"baseline/{name}")) for name in beside)
    rows += [dict.fromkeys(own) | shared | row_of_method(name, its, its) for name, its in every]
    return [{**row, "baseline": row is not rows[0], "value": row.get(row["figure"])} for row in rows]


def row_of_method(name: str, figures: Mapping[str, Any], times: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of one method: its name, figures and `COSTS`."""
    costs = {column: times.get(key) for column, key in COSTS.items()}
    figures = {key: value for key, value in figures.items() if key not in COSTS.values()}
    return {**figures, **costs, "method": name}


def score_db(row: Mapping[str, Any]) -> float:
    """Return the figure that places are given by, as decibels of which more are better."""
    return score_of(row["figure"], float(row["value"])) + 0.0  # -0.0 would be shown as such

"""Evaluation of one method beside the baselines: same data, metrics and clock."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.files import write_samples
from gsparc.data.assemble import identity_hash
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split, hash_indices
from gsparc.evaluation.by_station import (
    describe_never_listed,
    describe_new,
    station_columns,
    unlisted_stations,
)
from gsparc.evaluation.examples import FILE, Examples
from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.metric_formats import OF_LISTS, WITHOUT_OFF, judged_by, paired_values
from gsparc.evaluation.paired import lead_over_rows
from gsparc.evaluation.scores import Scores, rows_to_score, score_methods, unseen_runs
from gsparc.models.fitting import common_label
from gsparc.models.method import Method
from gsparc.physics.decibels import to_decibels
from gsparc.prediction import timing
from gsparc.prediction.hearing import Hearing
from gsparc.prediction.left_out import recondition_on_rows
from gsparc.prediction.timing import ClockSettings, query_calls, time_beside_copy, time_interleaved
from gsparc.runs.baselines import FittedBaseline, baselines_for, fit_baseline

log = logging.getLogger(__name__)

# results.py reads the key render_ms_batch64 by this number.
BATCH = 64
ROWS_OF = {"train": "training", "val": "left-out", "test": "test"}  # by what is scored
# Of one batch, from single queries; slower methods are not timed in batches
SLOWEST_BATCH_MS = 20_000.0
FIELD = "field"  # Gaussians of the evaluated method, without the process that they are mixed with


@dataclass(frozen=True)
class Evaluation:
    """Results of an evaluation.

    Attributes:
        facts: flat keys as in `summary.json`.
        columns: per-sample columns of `per_sample.csv`.
        stations: columns of `by_station.csv`, of powers of several stations.
        examples: a few test spectra as every method predicts them.
    """

    facts: dict[str, Any]
    columns: dict[str, Any]
    stations: dict[str, Any] = field(default_factory=dict)
    examples: Examples | None = None

    def write(self, folder: Path, **shared: Any) -> None:
        """Write what there is of `per_sample.csv`, `by_station.csv` and `predictions.npz`.

        `shared` are cells of every row.
        """
        for name, columns in (("per_sample.csv", self.columns), ("by_station.csv", self.stations)):
            if columns:
                write_samples(folder / name, columns | shared)
            else:
                (folder / name).unlink(missing_ok=True)  # of an earlier run, of other data
        if self.examples is not None:
            self.examples.write(folder / FILE)


@dataclass(frozen=True)
class TrainedRun:
    """What a run made, for callers from Python.

    Attributes:
        methods: one fitted method per fold.
        checkpoints: their files.
        data, split: what they learned from.
        evaluation: figures and per-sample columns.
    """

    methods: tuple[Method, ...]
    checkpoints: tuple[Path, ...]
    data: Measurements
    split: Split
    evaluation: Evaluation


def evaluate(
    methods: Method | Sequence[Method],
    train_s: float | Sequence[float] | None,
    data: Measurements,
    split: Split,
    *,
    eval_on: str = "test",
    baselines: Sequence[str] | None = None,
    clock: ClockSettings | None = None,
    learned: tuple[Measurements, Split] | None = None,
    shared: str | None = None,
    timed: bool = True,
    hearing: Sequence[Hearing] | None = None,
) -> Evaluation:
    """Score and time a method beside the baselines.

    Args:
        methods: one fitted method per fold (or the only one).
        train_s: seconds of each fold's training [s]; None when unknown.
        data: the dataset.
        split: as the methods were fitted with; test results are pooled over its folds.
        eval_on: `train`, `val` or `test`; also the prefix of the figures' keys.
        baselines: names in `gsparc.models.registry.all_methods()`; None: all plain that serve these
            rows.
        clock: how long to measure latencies.
        learned: what baselines learn from where the methods learned from other data; None: `data`,
            `split`.
        shared: the baseline that the methods are, which is then not fitted again.
        timed: whether latencies are measured.
        hearing: see `score_methods`; as checkpoints hold it.

    Where `split=none` left no test rows, a method that can forget its validation rows is scored and
    timed at them, as `val/*`; one that cannot is not.

    Returns:
        `test/*`, `baseline/<name>/*`, `time/*`, `machine/*`, `memory/*`, `model/*`,
        `dataset/*`, `split/*`.

    Raises:
        ValueError: as in `score_methods`.
    """
    methods = (methods,) if isinstance(methods, Method) else tuple(methods)
    seconds = None if train_s is None else [float(s) for s in np.atleast_1d(train_s)]
    if seconds is not None and len(seconds) != len(methods):
        raise ValueError(f"{len(seconds)} training times for {len(methods)} methods")
    if split.name == "none" and eval_on == "test":
        about = _about(methods, seconds, data, split)
        fold, compares = split.folds[0], timed and learned is None and baselines != []
        less = recondition_on_rows(methods[0], data, fold.train) if compares else None
        if less is None:
            return Evaluation(about, {})
        told: dict[str, Any] = {
            "eval_on": "val",
            "hearing": [Hearing.from_learned(data, fold.train)],
        }
        left_out = evaluate(less, seconds, data, split, baselines=baselines, clock=clock, **told)
        return replace(left_out, facts=left_out.facts | about)
    if hearing is None:
        learned_data, before = learned or (data, split)
        hearing = [Hearing.from_learned(learned_data, fold.learned()) for fold in before.folds]
    scores = score_methods(methods, data, split, eval_on, learned, hearing=hearing)
    # Which baselines serve is decided by the rows that they learn from, not by those scored.
    names = baselines_for(*(learned or (data, split))) if baselines is None else baselines
    if fitted := [name for name in names if name != shared]:
        log.info("%-10s%s", "baselines", ", ".join(fitted))
    # A method that is a baseline (model=gp) has one fit and one row:
    # another would only differ in seconds.
    same = FittedBaseline(methods, scores, tuple(seconds or ()))
    fits = {
        n: same if n == shared else fit_baseline(n, data, split, eval_on, learned, hearing)
        for n in names
    }
    others = {f"baseline/{name}": fit for name, fit in fits.items()}
    facts: dict[str, Any] = {}
    scores_of = {eval_on: scores, **{room: other.scores for room, other in others.items()}}
    # The first fold's methods alone are timed: folds differ in rows, hardly in cost.
    contenders = {"time": methods[0], **{room: other.methods[0] for room, other in others.items()}}
    fields = [
        field for field in (method.without_process() for method in methods) if field is not None
    ]
    # Only where each fold kept its field: figures of some folds would be of other rows
    # than those beside.
    if len(fields) == len(methods):
        scores_of[FIELD] = score_methods(fields, data, split, eval_on, learned, hearing=hearing)
        contenders[FIELD] = fields[0]
    nearest = scores_of.get("baseline/nearest")
    for room, rival in scores_of.items():
        figures = {**pool_figures(rival, data, split), "skill": _skill(rival, nearest)}
        facts |= {f"{room}/{figure}": value for figure, value in figures.items()}
    judged = judged_by({**facts, "dataset/kind": data.site.scored}, eval_on)
    cells = {"": scores_of}
    if off := [int(number) for number in unlisted_stations(scores, data).index]:
        # Rows of lists that they do not fill are judged by other levels:
        # it is no choice of rows alone.
        fitted_of = {eval_on: methods, **{room: other.methods for room, other in others.items()}}
        cells[WITHOUT_OFF] = {
            room: score_methods(fitted, data, split, eval_on, learned, off=off, hearing=hearing)
            for room, fitted in fitted_of.items()
        }
        for room, rival in cells[WITHOUT_OFF].items():
            rest = pool_figures(rival, data, split)
            facts |= {f"{room}/{name}{WITHOUT_OFF}": rest.get(name) for name in OF_LISTS}
    for (end, scored), (room, other), (ahead, figure) in product(
        cells.items(), others.items(), judged.items()
    ):
        pair = scored[room].samples, scored[eval_on].samples
        lead = lead_over_rows(*pair, figure, f"{ROWS_OF[eval_on]} rows")
        if lead is not None and other is not same:
            facts |= {f"{room}/{ahead}{end}{key}": value for key, value in lead.facts().items()}
    facts |= {f"{room}/train_s": float(np.mean(other.train_s)) for room, other in others.items()}
    facts[f"{eval_on}/unlisted"] = describe_never_listed(scores, data)
    facts[f"{eval_on}/new"] = None if learned is None else describe_new(learned[0], data)
    decided = scores.dominant_row()
    if decided and data.row_names:
        decided["decided_by/name"] = data.row_names[int(decided["decided_by/row"])]
    facts |= {f"{eval_on}/{k}": v for k, v in decided.items()}
    facts |= (
        time_methods(contenders, data, rows_to_score(split.folds[0], eval_on), clock)
        if timed
        else {}
    )
    facts["split/unseen_runs"] = sum(len(unseen_runs(data, fold, eval_on)) for fold in split.folds)
    facts |= _about(methods, seconds, data, split)
    if FIELD in scores_of:
        facts[f"{FIELD}/train_s"] = facts["time/train_s"]
    beside = {f"{room}/": other.scores for room, other in others.items()}
    columns = _columns(scores, data)
    for stem, rival in beside.items():
        columns |= {
            f"{stem}{name}": values for name, values in paired_values(rival.samples).items()
        }
    beside_it = {name: fit.methods[0] for name, fit in fits.items() if fit is not same}
    example_methods = beside_it | {methods[0].name: methods[0]}
    rows = rows_to_score(split.folds[0], eval_on)
    examples = (
        Examples.of_methods(example_methods, data, rows) if data.site.target.is_image else None
    )
    return Evaluation(facts, columns, station_columns({"": scores, **beside}, data), examples)


def _about(
    methods: Sequence[Method], seconds: Sequence[float] | None, data: Measurements, split: Split
) -> dict[str, Any]:
    """`model/*`, `dataset/*`, `split/*`, `machine/*`, `memory/*` and the seconds of training.

    Steps are means over folds, the rest of `model/*` is of the first.
    """
    first, facts_of_folds = methods[0], [method.facts() for method in methods]
    keys = [
        k
        for k in ("model/steps", "model/steps_taken")
        if len(facts_of_folds) > 1 and facts_of_folds[0].get(k) is not None
    ]
    model_facts = facts_of_folds[0] | {
        key: np.mean([facts[key] for facts in facts_of_folds]) for key in keys
    }
    return {
        "model/name": first.name,
        "model/label": common_label(first.name, methods),
        "model/effects": first.effects,
        **model_facts,
        "time/train_s": None if seconds is None else float(np.mean(seconds)),
        "time/train_total_s": None if seconds is None else float(sum(seconds)),
        **dataset_facts(data),
        **split_facts(split),
        **timing.machine_facts(),
        **timing.peak_memory(),
    }


def time_methods(
    methods: Mapping[str, Method],
    data: Measurements,
    rows: np.ndarray,
    clock: ClockSettings | None = None,
) -> dict[str, float | int | str | None]:
    """Return `time/*` and `<room>/render_ms_*` of methods by their rooms of facts, timed in turns.

    Methods slower than `SLOWEST_BATCH_MS` per batch have no batch figure:
    timing them would take minutes.
    """
    clock = clock or ClockSettings()
    single = time_beside_copy(query_calls(methods, data, rows), clock)
    # A batch is many queries already
    fewer = replace(clock, rounds=max(clock.least, clock.rounds // 5))
    quick = {
        name: m
        for name, m in methods.items()
        if single[name]["query_ms"] * BATCH < SLOWEST_BATCH_MS
    }
    # Without a copy beside them, which empties the caches.
    many = time_interleaved(query_calls(quick, data, rows, BATCH), fewer)
    first = next(iter(single.values()))
    shape = " x ".join(str(n) for n in data.target.shape[1:])
    facts: dict[str, float | int | str | None] = {
        "time/copy_ms": first["query_ms"] / first["to_copy"],
        "time/rounds": first["rounds"],
        "time/includes": (
            f"one query end to end, a position in host memory in, a {shape} {data.site.kind} in "
            "host memory "
            "out; warm, plans made before; no file, no picture"
        ),
    }
    for room, times in single.items():
        facts |= {f"{room}/{fact}": times[name] for name, fact in timing.FACTS.items()}
        together = float(np.median(many[room])) / BATCH if room in many else None
        facts[f"{room}/render_ms_batch{BATCH}"] = together
    return facts


def dataset_facts(data: Measurements) -> dict[str, Any]:
    """Return `dataset/*`."""
    names = ("name", "sha256", "stand_in", "convergence_error", "unknown_factor")
    seconds = data.provenance.get("simulate_s")
    return {
        **{f"dataset/{name}": getattr(data.site, name) for name in names},
        "dataset/kind": data.site.scored,
        "dataset/identity": identity_hash(data),
        "dataset/rows": len(data),
        "dataset/simulate_s": None if seconds is None else float(seconds),
    }


def split_facts(split: Split) -> dict[str, Any]:
    """Return `split/*`; counts are sums over folds."""
    counts = {
        f"split/{k}": sum(len(getattr(f, k)) for f in split.folds) for k in ("train", "val", "test")
    }
    hashes = {
        "split/sha256": split.sha256,
        "split/test_sha256": hash_indices(split.folds, ["test"]),
    }
    return {"split/name": split.name, **hashes, "split/folds": len(split.folds), **counts}


def _skill(scores: Scores, nearest: Scores | None) -> float | None:
    """1 - MSE / MSE(nearest), of powers in decibels; None without a neighbour,
    or when that one is right.
    """
    if nearest is None:
        return None
    # Rows without a target are NaN in both, so that the means are over the same rows.
    pairs = (scores_of_method.samples for scores_of_method in (scores, nearest))
    mse, bar = (
        float(np.nanmean(samples["error_db"] ** 2 if "error_db" in samples else samples["mse"]))
        for samples in pairs
    )
    return 1 - mse / bar if bar > 0 else None


def _columns(scores: Scores, data: Measurements) -> dict[str, Any]:
    # The last three are the moving end's place: where both move, columns are tx, then rx.
    world = data.moving[scores.row][:, -3:] + data.site.origin
    names = data.row_names or [f"row {i}" for i in range(len(data))]
    columns: dict[str, Any] = {
        "fold": scores.fold,
        "row": scores.row,
        "name": [names[i] for i in scores.row],
        "x_m": world[:, 0],
        "y_m": world[:, 1],
        "z_m": world[:, 2],
        # Of what was measured, not of stored targets:
        # channels and spectra have errors in these units.
        "confidence": scores.confidence,
        "variance": scores.variance * data.site.target_scale**2,
        **scores.samples,
        **paired_values(scores.samples),
    }
    if data.site.target.is_level:
        levels = {
            "predicted_db": scores.samples["prediction"],
            "measured_db": scores.samples["target"],
        }
        columns |= {
            name: to_decibels(np.where(power > 0, power, np.nan)) for name, power in levels.items()
        }
    of_row = data.stations_of(scores.row)
    columns |= {
        head: np.array(names)[of_row] for head, names in data.site.every_station.named.items()
    }
    for end in data.site.moving_ends[:-1]:
        other = data.ends[end][scores.row] + data.site.origin
        columns |= {f"{end}_{axis}_m": other[:, i] for i, axis in enumerate("xyz")}
    return columns

"""Results of runs as one table, a row a fit: what every table, plot, page and verdict reads."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gsparc.base.files import SUMMARY, load_yaml
from gsparc.evaluation.metric_formats import main_figure, score_of, scored_kind
from gsparc.models.checkpoint import MODEL
from gsparc.models.fitting import dotted_settings
from gsparc.models.registry import plain_methods
from gsparc.prediction.timing import FACTS, p50_p95

# Columns by the facts of a summary that they hold: of the run, of its own method, of any method.
OF_RUN = {
    "dataset": "dataset/name",
    "split": "split/name",
    "seed": "seed",
    "kind": "dataset/kind",
    "load": "machine/load",
    "data": "dataset/sha256",
    "git": "git",
    "simulate_s": "dataset/simulate_s",
    "rows": "split/sha256",
    "run_id": "run_id",
    "cpu": "machine/cpu",
}
OF_MODEL = {
    "label": "model/label",
    "gaussians": "model/num_gaussians",
    "memory_mb": "memory/peak_mb",
}
COSTS = {
    "train_s": "train_s",
    "train_cpu_s": "train_cpu_s",
    "batch_ms": "render_ms_batch64",
    **{name: FACTS[name] for name in ("query_ms", "query_p95_ms")},
}
PROBLEM = ["dataset", "split"]  # figures of one are comparable
# What decides a training
RESOLVED = ("model.", "init.", "trainer.", "callbacks.", "dataset.batch_size")
# Where data lie and how much is logged changes no result.
HIDDEN = (
    "seed",
    "split.seed",
    "dataset.root",
    "dataset.file",
    "baselines",
    "threads",
    "hydra",
    "experiment",
    "kind=",
    "logger",
)


@dataclass(frozen=True)
class Run:
    """Files of one training run.

    Attributes:
        folder: its directory.
        facts: `summary.json`.
        overrides: of the command line, `model.emission.hidden=8`.
        config: composed settings by dotted name.
    """

    folder: Path
    facts: dict[str, Any]
    overrides: tuple[str, ...] = ()
    config: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def samples(self) -> dict[str, np.ndarray]:
        """`per_sample.csv` by column; empty when absent."""
        return read_columns(self.folder / "per_sample.csv")

    @cached_property
    def render_ms(self) -> np.ndarray:
        """Times (n,) of single queries measured after a sweep, alone; empty when not [ms]."""
        return read_columns(self.folder / "render_ms.csv").get("render_ms", np.zeros(0))

    @property
    def checkpoints(self) -> list[Path]:
        """Its models, one per fold."""
        path = self.folder / MODEL
        return [path] if path.exists() else sorted(self.folder.glob(f"fold*/{MODEL}"))

    @property
    def resolved(self) -> dict[str, Any]:
        """Settings of the model, its training and data by name,
        with what was chosen for those at `auto`.
        """
        settings = {name: v for name, v in self.config.items() if name.startswith(RESOLVED)}
        # Choices of `auto` are words like `name=value` in one line of the summary.
        chosen = [
            choice.partition("=")
            for choice in str(self.facts.get("model/choices") or "").split(", ")
        ]
        return settings | {name: value for name, _, value in chosen if value}

    def swept(self, name: str) -> bool:
        """Return whether the command line set it."""
        return any(o.lstrip("+~").startswith(f"{name}=") for o in self.overrides)

    def rows(self, shared: Iterable[str] = ()) -> list[dict[str, Any]]:
        """Return its row of the table of results, then those of plain baselines, in their order.

        `shared` are overrides that tell it from no other run.
        """
        named = [
            o
            for o in self.overrides
            if o not in {*shared} and not o.lstrip("+~").startswith(HIDDEN)
        ]
        named = [o for o in named if not o.startswith(("model=", "dataset=", "split="))]
        run_row, *others = result_rows(self.facts)
        if len(self.render_ms):
            run_row["query_ms"], run_row["query_p95_ms"] = p50_p95(self.render_ms)
        short = [o.removeprefix("model.").removeprefix("trainer.") for o in named]
        rows = [run_row | {"setting": " ".join([str(run_row["method"]), *short])}]
        # A sweep may thin what baselines learn from; one that could not be fitted has no value.
        of = [o for o in named if o.lstrip("+~").startswith(("split.", "dataset.", "disturb"))]
        beside = {row["method"]: row for row in others if row["value"] is not None}
        rows += [
            beside[name] | {"setting": " ".join([f"{name} (baseline)", *of])}
            for name in plain_methods()
            if name in beside
        ]
        return [row | {"run": self} for row in rows]


def frame(*folders: str | Path) -> pd.DataFrame:
    """Return every fit in and below folders, a row each: runs in the order given,
    then baselines of each.

    Columns are those of `result_rows`, `setting` (what distinguishes it from others but seeds and
    draws: the method and its overrides) and `run`, its `Run`. What a summary does not tell is None.

    Raises:
        ValueError: a folder that does not exist or holds no run, or files of two runs; it is named.
    """
    runs: dict[Path, Run] = {}
    for path in map(Path, folders):
        if not path.is_dir():
            raise ValueError(f"{path}: no such directory; give run directories, or a sweep's")
        top = path / SUMMARY
        # A run with runs below it (folds) is one; a sweep's folder has a summary that is no run's.
        files = [top] if top.is_file() and _is_run(_facts(top)) else sorted(path.rglob(top.name))
        facts_of = {file.parent.resolve(): _facts(file) for file in files}
        run_folders = [folder for folder, facts in facts_of.items() if _is_run(facts)]
        if not run_folders and not any(path.rglob("tradeoff.csv")):
            raise ValueError(f"{path}: no run in it (a run leaves summary.json with test figures)")
        # A folder may be given twice, also by one above it.
        runs |= {folder: read_run(folder) for folder in run_folders if folder not in runs}
    if not runs:
        raise ValueError("a swept front is no report: give the directory of a run too")
    return frame_of_runs(runs.values())


def frame_of_runs(runs: Iterable[Run], shared: Iterable[str] = ()) -> pd.DataFrame:
    """Return the frame of runs that were read, see `frame`; `shared` as of `Run.rows`."""
    return as_frame(row for run in runs for row in run.rows(shared))


def as_frame(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows as a frame, None where one has no such column; `baseline` is boolean."""
    # object: pandas would make 1.0 of 1 where another row has None.
    table = pd.DataFrame(list(rows), dtype=object)
    table = table.where(table.notna(), None)
    return table.astype({"baseline": bool}) if len(table) else table


def short_settings(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the frame with settings by those overrides alone in which its runs differ."""
    runs = own_rows(rows).run
    # What all runs set tells none from another.
    shared = set.intersection(*(set(run.overrides) for run in runs)) if len(runs) > 1 else ()
    return frame_of_runs(runs, shared)


def own_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the runs' own methods."""
    return rows[~rows.baseline]


def distinct_baselines(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of the baselines of each split of the rows, of its first run."""
    return rows[rows.baseline].drop_duplicates(["rows", "setting"])


def average(rows: pd.DataFrame, by: list[str], names: list[str]) -> pd.DataFrame:
    """Return averages of the figures `names` of a frame, a row per group by columns `by`.

    Columns are, of each name, its `mean` over draws of the split, seeds of each draw averaged
    first, and the `error` of that, the standard error, NaN of one draw; `std`, `least` and
    `largest` are of all values, what seeds change where there is one draw.
    NaN of figures that the frame does not have.
    """
    table = rows.reindex(columns=[*dict.fromkeys([*rows, *names])]).astype(
        dict.fromkeys(names, float)
    )
    draws = table.groupby([*by, "draw"], dropna=False, sort=False)[names].mean().reset_index()
    of_draws, of_rows = (
        part.groupby(by, dropna=False, sort=False)[names] for part in (draws, table)
    )
    spread = {"std": of_rows.std(), "least": of_rows.min(), "largest": of_rows.max()}
    return pd.concat({"mean": of_draws.mean(), "error": of_draws.sem(), **spread}, axis=1)


def read_run(folder: Path) -> Run:
    """Return the run in a directory.

    Raises:
        ValueError: its files are of two runs.
    """
    run = Run(
        folder,
        _facts(folder / SUMMARY),
        tuple(map(str, _written(folder / ".hydra" / "overrides.yaml"))),
        dict(dotted_settings(_written(folder / ".hydra" / "config.yaml") or {})),
    )
    # A folder used twice, the second run killed, holds files of both.
    ids = {run.facts.get("run_id"), *run.samples.pop("run_id", np.zeros(0))[:1].tolist()}
    ids |= {_facts(split).get("run_id") for split in folder.glob("split.json")}
    if len(ids) > 1:
        raise ValueError(
            f"{folder}: its summary, samples and split are of two runs; train again elsewhere"
        )
    return run


def _is_run(facts: Mapping[str, Any]) -> bool:
    # A trade-off's summary has these keys, too.
    return "split/sha256" in facts and "time/train_s" in facts and "tradeoff/points" not in facts


def read_summary(path: str | Path) -> dict[str, Any] | None:
    """Return the facts of a summary; None where there is none, or no whole one."""
    try:
        facts = json.loads(Path(path).read_text(encoding="utf-8"))
    # ValueError: no JSON, as of a file that was cut off.
    except (OSError, ValueError):
        return None
    return facts if isinstance(facts, dict) else None


def _facts(file: Path) -> dict[str, Any]:
    facts = read_summary(file)
    if facts is None:
        raise ValueError(f"{file}: cannot be read as a summary, facts by name in JSON")
    return facts


def _written(path: Path) -> Any:
    """What Hydra wrote there, if anything."""
    return (load_yaml(path.read_text(encoding="utf-8"), path) if path.is_file() else None) or ()


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Return a CSV file by column: numbers float64 (NaN where empty), else text;
    {} without file or rows.
    """
    if not path.is_file():
        return {}
    # A sample or method may be called NA: only empty cells are missing.
    table = pd.read_csv(path, keep_default_na=False, na_values=[""])
    # Whole numbers too: the same column of another run may have gaps.
    table = table.astype(dict.fromkeys(table.select_dtypes("number"), float))
    return {} if table.empty else {name: table[name].to_numpy() for name in table}


def facts_under(facts: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the facts whose names begin with `prefix/`, without it."""
    stem = f"{prefix}/"
    return {name[len(stem) :]: value for name, value in facts.items() if name.startswith(stem)}


def result_rows(facts: Mapping[str, Any], prefix: str = "test") -> list[dict[str, Any]]:
    """Return the row of a run's method and those of the baselines beside it,
    from the facts of its summary.

    Figures are of rows `prefix`: `test`, `train` or `val`. Columns are those of `OF_RUN`,
    `OF_MODEL` and `COSTS`; `draw` of its test rows, `fold` (None: all are pooled), `method`,
    `baseline` (whether it is one), `measured` (rows that a model learned from), `effects`, `figure`
    (the deciding one), its `value`, that of Gaussians `alone`, and every figure under its own name;
    None where a summary has no such fact.
    """
    # Counts of a summary are sums over folds; `measured` is per model.
    counts = [int(facts.get(f"split/{name}") or 0) for name in ("train", "val", "folds")]
    folds = max(counts[2], 1)
    shared: dict[str, Any] = {name: facts.get(key) for name, key in OF_RUN.items()}
    # Test rows alone: a seed may move those of validation only.
    # Older summaries have one hash of all.
    shared["draw"] = str(facts.get("split/test_sha256", facts.get("split/sha256")))[:8]
    shared["kind"] = scored_kind(facts)
    shared |= {
        "fold": 0 if folds == 1 else None,
        "figure": main_figure(facts, prefix),
        "alone": None,
    }
    shared |= {"measured": sum(counts[:2]) // folds, "effects": "none"}
    model_facts = {name: facts.get(key) for name, key in OF_MODEL.items()}
    model = model_facts | {"effects": facts.get("model/effects") or "none"}
    model["alone"] = facts.get(f"field/{shared['figure']}")
    name = str(facts.get("model/name", "?"))
    rows = [
        shared | model | row_of_method(name, facts_under(facts, prefix), facts_under(facts, "time"))
    ]
    # dict.fromkeys: a set of names would forget the order that the summary has them in.
    beside = dict.fromkeys(name.split("/")[1] for name in facts if name.startswith("baseline/"))
    baselines = ((name, facts_under(facts, f"baseline/{name}")) for name in beside)
    rows += [
        dict.fromkeys(model_facts) | shared | row_of_method(name, its, its)
        for name, its in baselines
    ]
    return [
        {**row, "baseline": row is not rows[0], "value": row.get(row["figure"])} for row in rows
    ]


def row_of_method(
    name: str, figures: Mapping[str, Any], times: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the columns of one method: its name, figures and `COSTS`."""
    costs = {column: times.get(key) for column, key in COSTS.items()}
    figures = {key: value for key, value in figures.items() if key not in COSTS.values()}
    return {**figures, **costs, "method": name}


def score_db(row: Mapping[str, Any]) -> float:
    """Return the figure that places are given by, as decibels of which more are better."""
    return score_of(row["figure"], float(row["value"])) + 0.0  # -0.0 would be shown as such

"""Run directories read for the report, and their models timed again."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from gsparc.data.files import SUMMARY, load_yaml
from gsparc.evaluation.baselines import BASELINES
from gsparc.evaluation.open_runs import open_files
from gsparc.evaluation.results import result_rows
from gsparc.evaluation.summary import read_summary, write_samples
from gsparc.models.fitting import dotted_settings
from gsparc.prediction.timing import BLOCKS, Call, p50_p95, time_interleaved

RESOLVED = ("model.", "init.", "trainer.", "callbacks.", "dataset.batch_size")  # what decides a training
# Where data lie and how much is logged changes no result.
HIDDEN = (
    "seed", "split.seed", "dataset.root", "dataset.file", "baselines", "threads", "hydra", "experiment",
    "logger",
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    """Files of one training run.

    Attributes:
        folder: its directory.
        facts: `summary.json`.
        samples: `per_sample.csv` by column; empty when absent.
        overrides: of the command line, `model.emission.hidden=8`.
        config: composed settings by dotted name.
        render_ms: (n,) times of single queries measured after a sweep, alone; empty when not.
    """

    folder: Path
    facts: dict[str, Any]
    samples: dict[str, np.ndarray] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()
    config: dict[str, Any] = field(default_factory=dict)
    render_ms: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def row(self) -> dict[str, Any]:
        """Its own row of the results, with `setting`, and times measured alone, where they were."""
        own = {**self.rows[0], "setting": self.setting, "run": self}
        if len(self.render_ms):
            own["query_ms"], own["query_p95_ms"] = p50_p95(self.render_ms)
        return own

    @property
    def baselines(self) -> list[dict[str, Any]]:
        """Rows of the plain baselines beside it, in the order of `BASELINES`."""
        # A baseline that could not be fitted has a row without a value.
        beside = {row["method"]: row for row in self.rows[1:] if row["value"] is not None}
        # A sweep may thin what they learn from.
        of = [o for o in self._named if o.lstrip("+~").startswith(("split.", "dataset."))]
        settings = {n: " ".join([f"{n} (baseline)", *of]) for n in BASELINES if n in beside}
        return [{**beside[name], "setting": setting, "run": self} for name, setting in settings.items()]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """See `result_rows`; of unknown data those of spectra."""
        return result_rows(self.facts)

    @cached_property
    def setting(self) -> str:
        """What distinguishes it from others but seeds and draws: the method and its overrides."""
        short = [o.removeprefix("model.").removeprefix("trainer.") for o in self._named]
        return " ".join([str(self.facts.get("model/name", "?")), *short])

    @property
    def _named(self) -> list[str]:
        overrides = [o for o in self.overrides if not o.lstrip("+~").startswith(HIDDEN)]
        return [o for o in overrides if not o.startswith(("model=", "dataset=", "split="))]

    @property
    def resolved(self) -> dict[str, Any]:
        """Settings of the model, its training and data by name, with what was chosen for those at `auto`."""
        own = {name: v for name, v in self.config.items() if name.startswith(RESOLVED)}
        # Choices of `auto` are words like `name=value` in one line of the summary.
        chosen = [one.partition("=") for one in str(self.facts.get("model/choices") or "").split(", ")]
        return own | {name: value for name, _, value in chosen if value}

    def swept(self, name: str) -> bool:
        """Return whether the command line set it."""
        return any(o.lstrip("+~").startswith(f"{name}=") for o in self.overrides)

    @property
    def study(self) -> tuple[str, str]:
        """What makes figures comparable: dataset and split by name."""
        return str(self.row["dataset"]), str(self.row["split"])

    @property
    def checkpoints(self) -> list[Path]:
        """Its models, one per fold."""
        path = self.folder / "model.ckpt"
        return [path] if path.exists() else sorted(self.folder.glob("fold*/model.ckpt"))


def find_runs(paths: Iterable[str | Path]) -> list[Run]:
    """Return training runs in and below directories, in the order given.

    Raises:
        ValueError: a directory that does not exist or holds no run; it is named.
    """
    runs: dict[Path, Run] = {}
    for path in map(Path, paths):
        if not path.is_dir():
            raise ValueError(f"{path}: no such directory; give run directories, or a sweep's")
        own = path / SUMMARY
        # A run with runs below it (folds) is one; a sweep's folder has a summary that is no run's.
        files = [own] if own.is_file() and _is_run(_facts(own)) else sorted(path.rglob(own.name))
        every = {file.parent.resolve(): _facts(file) for file in files}
        here = [folder for folder, facts in every.items() if _is_run(facts)]
        if not here and not any(path.rglob("tradeoff.csv")):
            raise ValueError(f"{path}: no run in it (a run leaves summary.json with test figures)")
        # A folder may be given twice, also by one above it.
        runs |= {folder: read_run(folder) for folder in here if folder not in runs}
    if not runs:
        raise ValueError("a swept front is no report: give the directory of a run too")
    return list(runs.values())


def group_in_order(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Return items by what `key` returns of them, in order of appearance."""
    groups: dict[Any, list[Any]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def group_by_study(runs: Iterable[Run]) -> dict[tuple[str, str], list[Run]]:
    """Return runs whose figures can be compared, by dataset and split, in order of appearance."""
    return group_in_order(runs, lambda run: run.study)


def distinct_baselines(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return rows of the baselines of each split of the rows, of its first run."""
    every: dict[tuple[str, str], dict[str, Any]] = {}
    for base in (base for run in runs for base in run.baselines):
        every.setdefault((base["rows"], base["setting"]), base)
    return list(every.values())


def drop_shared_overrides(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with only those overrides in which they differ, so that names are short."""
    if len(runs) < 2:
        return list(runs)
    # What all runs set tells none from another.
    shared = set.intersection(*(set(run.overrides) for run in runs))
    return [replace(run, overrides=tuple(o for o in run.overrides if o not in shared)) for run in runs]


def _is_run(facts: Mapping[str, Any]) -> bool:
    # A trade-off's summary has these keys, too.
    return "split/sha256" in facts and "time/train_s" in facts and "tradeoff/points" not in facts


def _facts(file: Path) -> dict[str, Any]:
    facts = read_summary(file)
    if facts is None:
        raise ValueError(f"{file}: cannot be read as a summary, facts by name in JSON")
    return facts


def read_run(folder: Path) -> Run:
    """Return the run in a directory.

    Raises:
        ValueError: its files are of two runs.
    """
    render = read_columns(folder / "render_ms.csv").get("render_ms")
    facts, samples = _facts(folder / SUMMARY), read_columns(folder / "per_sample.csv")
    # A folder used twice, the second run killed, holds files of both.
    runs = {facts.get("run_id"), *samples.pop("run_id", np.zeros(0))[:1].tolist()}
    runs |= {_facts(split).get("run_id") for split in folder.glob("split.json")}
    if len(runs) > 1:
        raise ValueError(f"{folder}: its summary, samples and split are of two runs; train again elsewhere")
    return Run(
        folder,
        facts,
        samples,
        tuple(map(str, _written(folder / ".hydra" / "overrides.yaml"))),
        dict(dotted_settings(_written(folder / ".hydra" / "config.yaml") or {})),
        np.zeros(0) if render is None else render,
    )


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Return a CSV file by column: numbers float64 (NaN where empty), else text; {} without file or rows."""
    if not path.is_file():
        return {}
    # A sample or method may be called NA: only empty cells are missing.
    frame = pd.read_csv(path, keep_default_na=False, na_values=[""])
    # Whole numbers too: the same column of another run may have gaps.
    frame = frame.astype(dict.fromkeys(frame.select_dtypes("number"), float))
    return {} if frame.empty else {name: frame[name].to_numpy() for name in frame}


def _written(path: Path) -> Any:
    """What Hydra wrote there, if anything."""
    return (load_yaml(path.read_text(encoding="utf-8"), path) if path.is_file() else None) or ()


def error_sizes(run: Run, name: str) -> np.ndarray:
    """Return a per-sample figure (n,) of a run, empty where it has none; an error by its size."""
    values = run.samples.get(name, np.zeros(0))
    return np.abs(values) if name == "error_db" else values


log = logging.getLogger(__name__)


def time_again(runs: Sequence[Run], *, rounds: int = 40, rounds_s: float = 60.0) -> list[Run]:
    """Return the runs with the times of single queries, each also written to its `render_ms.csv`.

    A sweep runs jobs at the same time, which disturbs their times; call this after it.

    Args:
        runs: those without a readable checkpoint keep the times they have.
        rounds: visits to each.
        rounds_s: no new round after this [s].
    """
    calls: dict[int, Call] = {}
    for number, run in enumerate(runs):
        try:
            opened = open_files(run.checkpoints[:1])
            # A folder used twice may hold the model of one run beside the summary of the other.
            if opened.stored[0].extra.get("run_id") != run.facts.get("run_id"):
                raise ValueError("its checkpoint is of another run than its summary")
            if not len(opened.split.folds[0].test):
                log.warning("%s is not timed again: it has no test rows", run.folder)
                continue
        except (ValueError, IndexError) as error:
            log.warning("%s is not timed again: %s", run.folder, error or "it left no checkpoint")
            continue
        calls[number] = opened.predictor.cycle_places(opened.data.moving[opened.split.folds[0].test])
    threads = {
        number: int(runs[number].facts.get("machine/threads") or torch.get_num_threads()) for number in calls
    }
    times = time_interleaved(calls, replace(BLOCKS, rounds=rounds, rounds_s=rounds_s), threads)
    for number, ms in times.items():
        write_samples(runs[number].folder / "render_ms.csv", {"render_ms": ms})
    return [replace(run, render_ms=times[i]) if i in times else run for i, run in enumerate(runs)]

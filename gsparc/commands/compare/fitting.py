"""A cell filled: composed, trained on every fold, scored, and kept."""

from __future__ import annotations

import json
import logging
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.compare.cells import Cell, Contender, key
from gsparc.commands.context import context_of
from gsparc.commands.settings import plain
from gsparc.commands.study.run import fit_and_score, in_folders
from gsparc.data.load import load, split_for
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.evaluate import dataset_facts, split_facts
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.methods import checkpoint
from gsparc.methods.method import FitReport, Method
from gsparc.methods.registry import build
from gsparc.methods.timing import machine_facts

log = logging.getLogger(__name__)

RESULT = "cell.json"
FREE_S = 5.0  # guessed for a method without a budget
EARLIER = "measured at commit"  # among the facts of a result of earlier program text


@dataclass(frozen=True)
class Problem:
    """One dataset under one split; its measurements may be absent, then kept results say what they were.

    Attributes:
        dataset, split: names.
        kind: of the measurements.
        hashes: of measurements and folds.
        data: measurements; None where they are not here.
        folds: which rows learn and which test.
    """

    dataset: str
    split: str
    kind: str
    hashes: tuple[str, str]
    data: Measurements | None = None
    folds: Split | None = None

    @classmethod
    def of(cls, dataset: str, split: str, data: Measurements, folds: Split) -> Problem:
        """With its measurements."""
        return cls(dataset, split, data.site.kind, (data.site.sha256, folds.sha256), data, folds)

    def present(self) -> tuple[Measurements, Split]:
        """Measurements and folds.

        Raises:
            ValueError: they are not here.
        """
        if self.data is None or self.folds is None:
            raise ValueError(f"{self.dataset}/{self.split}: the measurements are not here")
        return self.data, self.folds


def stored_problems(kept: Path, dataset: str, splits: Sequence[str]) -> list[Problem]:
    """The problems of a dataset that most kept results are of, one per split."""
    found = []
    for split in splits:
        files = sorted(kept.glob(f"{dataset}-{split}-*/{RESULT}"))
        facts = [json.loads(file.read_text(encoding="utf-8")) for file in files]
        known = Counter((f["dataset/kind"], f["dataset/sha256"], f["split/sha256"]) for f in facts)
        if known:
            kind, *hashes = known.most_common(1)[0][0]
            found.append(Problem(dataset, split, kind, (hashes[0], hashes[1])))
    return found


def load_problems(dataset: str, settings: dict[str, Any], splits: Sequence[str]) -> list[Problem]:
    """Load what `conf/dataset` names, with the given paths, once for all splits of `conf/split`."""
    configs = [compose(dataset, settings, split, []) for split in splits]
    data = load(plain(configs[0].dataset))
    return [
        Problem.of(dataset, split, data, split_for(plain(config.split), data))
        for split, config in zip(splits, configs, strict=True)
    ]


def compose(dataset: str, settings: dict[str, Any], split: str, overrides: list[str]) -> DictConfig:
    """The configuration `train.py` would see."""
    chosen = [f"dataset={dataset}", f"split={split}", "logger=none", "~callbacks.pictures", *overrides]
    config = hydra.compose("train", overrides=[*chosen, "hydra.run.dir=."])
    OmegaConf.update(config, "dataset", settings, merge=True)
    return config


@dataclass(frozen=True)
class Filled:
    """A cell with its result.

    Attributes:
        cell: which.
        folder: where its checkpoints are.
        facts: flat, as in `summary.json`: `test/*`, `time/*`, `model/*`, `dataset/*`, `machine/*`.
    """

    cell: Cell
    folder: Path
    facts: dict[str, Any]

    @property
    def earlier(self) -> str | None:
        """Commit of an earlier program text that it was measured with; None for this one's."""
        return self.facts.get(EARLIER)

    def scored(self) -> bool:
        """Whether it was tested, not only timed."""
        return any(name.startswith("test/") for name in self.facts)

    @property
    def checkpoint(self) -> Path:
        """Of the first fold."""
        return self.folder / "fold0.ckpt"


@dataclass(frozen=True)
class Prepared:
    """A cell of a problem, composed but not yet trained."""

    cell: Cell
    problem: Problem
    config: DictConfig
    folder: Path
    scored: bool = True

    @property
    def expected_s(self) -> float:
        """Seconds it will take: its budget on every fold, and something for scoring [s]; 0 without data."""
        folds = self.problem.folds
        return 0.0 if folds is None else len(folds.folds) * ((self.cell.budget_s or FREE_S) + 2.0)

    def found(self) -> Filled | None:
        """The kept result, if there is a whole one."""
        try:
            facts = json.loads((self.folder / RESULT).read_text(encoding="utf-8"))
        except (OSError, json.JSONDecodeError):
            return None
        return Filled(self.cell, self.folder, facts)

    def found_earlier(self) -> Filled | None:
        """The latest result of other program text or settings for this cell, the same data and split.

        Published results outlive the code they were measured with; a table must say so, not lose them.
        """
        stem = self.folder.name.rpartition("-")[0]
        same: dict[str, Any] = {"seed": self.cell.seed, "budget_s": self.cell.budget_s}
        same |= dict(zip(("dataset/sha256", "split/sha256"), self.problem.hashes, strict=True))
        files = self.folder.parent.glob(f"{stem}-*/{RESULT}")
        every = {file.parent: json.loads(file.read_text(encoding="utf-8")) for file in files}
        found = {path: f for path, f in every.items() if all(f.get(k) == v for k, v in same.items())}
        if not found:
            return None
        folder, facts = max(found.items(), key=lambda item: item[1].get("made") or "")
        return Filled(self.cell, folder, {**facts, EARLIER: str(facts.get("git"))[:8]})


def prepare(
    cell: Cell, contender: Contender, settings: dict[str, Any], problem: Problem, kept: Path
) -> Prepared:
    """Compose a cell's configuration and name the folder of its result."""
    config = compose(cell.dataset, settings, cell.split, contender.overrides(cell.budget_s, cell.seed))
    whole = plain(config)
    trainer = {name: whole[name] for name in ("trainer", "callbacks", "budget_s")}
    name = key(whole["model"], trainer, *problem.hashes)
    folder = kept / f"{cell.dataset}-{cell.split}-{cell.method}-{name}"
    return Prepared(cell, problem, config, folder, not contender.timed_only)


def fill(prepared: Prepared) -> Filled:
    """Train on every fold, score on the test rows, write checkpoints and then the result.

    Raises:
        ValueError: the method does not serve these data.
        RuntimeError: training diverged.
    """
    config, folder, (data, split) = prepared.config, prepared.folder, prepared.problem.present()
    yaml = OmegaConf.to_yaml(config, resolve=True)

    def keep(number: int, method: Method, report: FitReport) -> None:
        extra = {"train_s": report.seconds, "fold": number, "split_sha256": split.sha256}
        checkpoint.save(folder / f"fold{number}.ckpt", method, yaml, extra)

    folds = split if prepared.scored else replace(split, folds=split.folds[:1])
    found = fit_and_score(
        partial(build, config.model), data, folds, in_folders(context_of(config, run_dir=folder)),
        eval_on="test" if prepared.scored else None, keep=keep,
    )  # fmt: skip
    facts: dict[str, Any] = {f"test/{name}": value for name, value in found.figures.items()}
    facts |= {
        "time/train_s": statistics.fmean(found.train_s),
        "time/train_cpu_s": statistics.fmean(found.train_cpu_s),
        "time/score_s": found.score_s,
        "model/name": prepared.cell.method,
        "model/num_gaussians": found.methods[0].size(),
        "model/effects": found.methods[0].effects,
        "model/notes": "; ".join(found.notes),
        "seed": prepared.cell.seed,
        "budget_s": prepared.cell.budget_s,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    facts |= dataset_facts(data) | split_facts(split) | machine_facts() | provenance()
    write_summary(folder / RESULT, facts)  # last: a cell without it does not count
    return Filled(prepared.cell, folder, facts)

"""A cell filled: composed, trained on every fold, scored, and kept."""

from __future__ import annotations

import logging
import statistics
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsparc.data.executor import each
from gsparc.data.files import no_room
from gsparc.data.schema import Kind
from gsparc.evaluation.console import one_line, plain
from gsparc.evaluation.evaluate import dataset_facts, split_facts
from gsparc.evaluation.experiment.cells import Cell, Contender, key
from gsparc.evaluation.experiment.fit import context_of, fit_folds, in_folders
from gsparc.evaluation.experiment.problem import RESULT, Problem, compose, facts_of
from gsparc.evaluation.metric_formats import DECIDING, score_of
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.models import checkpoint
from gsparc.models.method import Method
from gsparc.models.parts import common_label
from gsparc.models.registry import build
from gsparc.prediction.timing import machine_facts
from gsparc.training.context import FitReport

log = logging.getLogger(__name__)

FREE_S = 5.0  # guessed for a method without a budget
EARLIER = "measured at commit"  # among the facts of a result of earlier program text


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

    @property
    def drawn(self) -> bool:
        """Whether its seed is a draw of the split."""
        return bool(self.facts.get("problem/drawn"))

    def scored(self) -> bool:
        """Whether it was tested, not only timed."""
        return any(name.startswith("test/") for name in self.facts)

    @property
    def checkpoint(self) -> Path:
        """Of the first fold."""
        return self.folder / "fold0.ckpt"


def score_db(kind: Kind, facts: Mapping[str, Any]) -> float:
    """The figure places are given by, as decibels of which more are better."""
    figure = DECIDING[kind]
    return score_of(figure, float(facts[f"test/{figure}"]))


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

    def result(self) -> Filled | None:
        """The kept result, if there is a whole one."""
        facts = facts_of(self.folder / RESULT)
        return None if facts is None else Filled(self.cell, self.folder, facts)

    def old_result(self) -> Filled | None:
        """The latest result of other program text or settings for this cell, the same data and split.

        Published results outlive the code they were measured with; a table must say so, not lose them.
        """
        stem = self.folder.name.rpartition("-")[0]
        same: dict[str, Any] = {"seed": self.cell.seed, "budget_s": self.cell.budget_s}
        data, folds, whole = self.problem.hashes
        same |= {"dataset/sha256": data, "split/sha256": folds}
        files = self.folder.parent.glob(f"{stem}-*/{RESULT}")
        every = {file.parent: facts_of(file) or {} for file in files}
        results = {path: f for path, f in every.items() if all(f.get(k) == v for k, v in same.items())}
        results = {path: f for path, f in results.items() if f.get("dataset/identity", whole) == whole}
        if not results:
            return None
        folder, facts = max(results.items(), key=lambda item: item[1].get("made") or "")
        return Filled(self.cell, folder, {**facts, EARLIER: str(facts.get("git"))[:8]})


def prepare(
    cell: Cell, contender: Contender, settings: Mapping[str, Any], problem: Problem, cells_dir: Path
) -> Prepared:
    """Compose a cell's configuration and name the folder of its result."""
    chosen = problem.chosen or (f"dataset={settings.get('dataset', cell.dataset)}",)
    overrides = [*chosen, *contender.overrides(cell.budget_s)]
    config = compose(settings, overrides, problem.draw, cell.seed)
    whole = plain(config)
    beside = ("trainer", "callbacks", "effort", "budget_s", "budget_clock", "init_from", "stations")
    trainer = {name: whole[name] for name in beside} | {"batch_size": whole["dataset"].get("batch_size")}
    for file in ((whole["model"].get("init") or {}).get("file"), whole["init_from"]):
        if file and Path(file).is_file():  # walls, and a start, may change under their names
            trainer[Path(file).name] = sha256(Path(file).read_bytes()).hexdigest()
    if problem.draw is None and cell.seed and "seed" not in whole["model"]:
        trainer["seed"] = cell.seed  # of a draw, the split's own hash tells
    name = key(whole["model"], trainer, *problem.hashes)
    folder = cells_dir / f"{cell.dataset}-{cell.split}-{cell.method}-{name}"
    return Prepared(cell, problem, config, folder, not contender.timed_only)


def fill(prepared: Prepared) -> Filled:
    """Train on every fold, score on the test rows, write checkpoints and then the result.

    Of a split that is drawn several times, the models of the first draw are kept.

    Raises:
        ValueError: the method does not serve these data.
        RuntimeError: training diverged.
    """
    config, folder, (data, split) = prepared.config, prepared.folder, prepared.problem.present()
    yaml = OmegaConf.to_yaml(config, resolve=True)

    def keep(number: int, method: Method, report: FitReport) -> None:
        if prepared.problem.draw:  # queries are timed with models of the first draw
            return
        extra = {"train_s": report.seconds, "fold": number, "split_sha256": split.sha256}
        checkpoint.save(folder / f"fold{number}.ckpt", method, yaml, extra)

    folds = split if prepared.scored else replace(split, folds=split.folds[:1])
    contexts = in_folders(context_of(config, run_dir=folder), folds)
    outcome = fit_folds(partial(build, config.model), data, folds, contexts, keep=keep)
    if prepared.scored:
        outcome = outcome.scored_on(data, folds)
    facts: dict[str, Any] = {f"test/{name}": value for name, value in outcome.figures.items()}
    facts |= {
        "time/train_s": statistics.fmean(outcome.train_s),
        "time/train_cpu_s": statistics.fmean(outcome.train_cpu_s),
        "time/score_s": outcome.score_s,
        "model/name": prepared.cell.method,
        **outcome.methods[0].facts(),
        "model/label": common_label(outcome.methods[0].name, outcome.methods),
        "model/effects": outcome.methods[0].effects,
        "model/notes": "; ".join(outcome.notes),
        "problem/drawn": prepared.problem.draw is not None,
        "problem/stations": prepared.problem.stations,
        "problem/scene": prepared.problem.scene,
        "seed": prepared.cell.seed,
        "budget_s": prepared.cell.budget_s,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    facts |= dataset_facts(data) | split_facts(split) | machine_facts() | provenance()
    write_summary(folder / RESULT, facts)  # last: a cell without it does not count
    return Filled(prepared.cell, folder, facts)


def _tried(one: Prepared) -> Filled | str:
    """The cell, or why it cannot be filled; the other methods' table comes nevertheless."""
    try:
        return one.result() or fill(one)
    except Exception as error:  # any error of a plugin
        if no_room(error):  # the others would be trained in vain
            raise
        unforeseen = not isinstance(error, ValueError | RuntimeError)  # says where it is
        return one_line(error) + (f"\n{traceback.format_exc()}" if unforeseen else "")


def fill_all(prepared: Sequence[Prepared], train: bool = True, limit_s: float | None = None) -> list[Filled]:
    """Find or fill cells, saying how far it is and how long it will take.

    A cell that cannot be filled is said and left out; the others go on. One that is not tried keeps what was
    measured with earlier program text.

    Args:
        prepared: the most wanted first.
        train: whether missing cells are filled.
        limit_s: no cell is started that would end later [s].
    """
    missing = [one for one in prepared if one.result() is None]
    log.info("%d cells, %d of them are there", len(prepared), len(prepared) - len(missing))
    started, broken = time.monotonic(), set[str]()

    def fits(one: Prepared) -> bool:
        late = limit_s is not None and time.monotonic() - started + one.expected_s > limit_s
        if late:
            log.warning("max_hours: %s is not started", one.cell)
        return not late

    here = [one for one in missing if train and one.problem.data is not None]
    try:
        for number, result in each(_tried, here, "cells", cost=lambda one: one.expected_s, wanted=fits):
            if isinstance(result, str):
                log.warning("%s cannot be filled: %s", here[number].cell, result)
                broken.add(str(here[number].cell))
                continue
            score = (
                f"{score_db(result.facts['dataset/kind'], result.facts):.2f} dB" if result.scored() else "-"
            )
            log.info("%s: %s after %.1f s", result.cell, score, result.facts["time/train_s"])
    except KeyboardInterrupt:
        message = "interrupted; finished cells are kept: the same command goes on with the others"
        raise KeyboardInterrupt(message) from None
    results = [one.result() or (None if str(one.cell) in broken else one.old_result()) for one in prepared]
    return [one for one in results if one is not None]

"""The cells of a comparison done: each is a run in a folder of its own, whose summary is its result."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from gsparc.data.executor import run_each
from gsparc.data.files import is_out_of_space
from gsparc.evaluation.console import error_in_one_line
from gsparc.evaluation.experiment.cells import Cell, Contender
from gsparc.evaluation.experiment.done import State, read_finished, run_once
from gsparc.evaluation.experiment.problem import Problem, compose
from gsparc.evaluation.metric_formats import number_format
from gsparc.evaluation.report.runs import read_columns
from gsparc.evaluation.results import result_rows
from gsparc.models.checkpoint import MODEL

log = logging.getLogger(__name__)

FREE_S, EFFORT_S = 5.0, 60.0  # guessed for a method that counts nothing; for one of effort 1


@dataclass(frozen=True)
class CellResult:
    """A cell with its result.

    Attributes:
        cell: which.
        folder: of its run.
        facts: of its summary: `test/*`, `time/*`, `model/*`, `dataset/*`, `machine/*`.
        drawn: whether its seed is a draw of the split.
        earlier: commit of another program that it was measured with; "" for this one's.
    """

    cell: Cell
    folder: Path
    facts: dict[str, Any]
    drawn: bool = False
    earlier: str = ""

    @property
    def row(self) -> dict[str, Any]:
        """Return the row of the table of results, its seed None where the method has none."""
        return {**result_rows(self.facts)[0], "seed": self.cell.seed, "run": self}

    @cached_property
    def samples(self) -> dict[str, np.ndarray]:
        """Return `per_sample.csv` by column."""
        return read_columns(self.folder / "per_sample.csv")

    @property
    def checkpoint(self) -> Path:
        """Return the file of the first fold's model."""
        return next((file for file in self.folder.glob(f"fold0/{MODEL}")), self.folder / MODEL)


@dataclass(frozen=True)
class PreparedCell:
    """A cell of a problem, composed but not yet trained.

    Attributes:
        cell, problem: which.
        config: what the run is configured by.
        folder: of the run.
        state: that its result is to be of.
        reuse: whether a result of another program counts, too.
    """

    cell: Cell
    problem: Problem
    config: DictConfig
    folder: Path
    state: State
    reuse: bool = False

    @property
    def expected_s(self) -> float:
        """Seconds it may take, guessed by its effort, and something for scoring [s]."""
        # Two seconds for loading and scoring a fold; time left and `limit_s` go by this.
        fit_s = FREE_S if self.cell.effort is None else EFFORT_S * self.cell.effort
        return len(self.problem.folds.folds) * (fit_s + 2.0)

    def result(self) -> CellResult | None:
        """Return the result, if it is done."""
        facts = read_finished(self.folder, self.state, self.reuse)
        return None if facts is None else self.filled(facts)

    def filled(self, facts: dict[str, Any]) -> CellResult:
        """Return the cell with these facts."""
        # The program's hash, not the commit, decides: most commits change nothing that a method computes.
        earlier = "" if facts.get("program") == self.state.program else str(facts.get("git"))[:8]
        return CellResult(self.cell, self.folder, facts, self.problem.draw is not None, earlier)


def prepare_cell(
    cell: Cell, contender: Contender, settings: Mapping[str, Any], problem: Problem, cells_dir: Path,
    reuse: bool = False,
) -> PreparedCell:  # fmt: skip
    """Compose a cell's configuration and name its folder, `dataset/split/method/effort/seed`."""
    overrides = [*problem.chosen, *contender.overrides(cell.effort)]
    config = compose(settings, overrides, problem.draw, cell.seed)
    state = State.from_config(config, problem.content, problem.folds.sha256)
    return PreparedCell(cell, problem, config, cells_dir / str(cell), state, reuse)


Run = Callable[[PreparedCell, str | None], object]


def _tried(run: Run, one: PreparedCell) -> CellResult | str:
    """The cell, or why it cannot be filled; one failing cell does not stop the table."""
    try:
        return one.filled(run_once(one.folder, one.state, partial(run, one), reuse=one.reuse))
    except Exception as error:  # any error of a plugin
        if is_out_of_space(error):  # the others would be trained in vain
            raise
        unforeseen = not isinstance(error, ValueError | RuntimeError)  # says where it is
        return error_in_one_line(error) + (f"\n{traceback.format_exc()}" if unforeseen else "")


def run_cells(
    prepared: Sequence[PreparedCell], run: Run, train: bool = True, limit_s: float | None = None
) -> list[CellResult]:
    """Find or fill cells, saying how far it is and how long it will take.

    A cell that cannot be filled is said and left out; the others go on.

    Args:
        prepared: the most wanted first.
        run: trains a cell into its folder, from what an interrupted try has left there.
        train: whether missing cells are filled.
        limit_s: no cell is started that would end later [s].
    """
    there = [one.result() for one in prepared]
    found = {str(one.cell): one for one in there if one is not None}
    missing = [one for one in prepared if str(one.cell) not in found]
    log.info("%d cells, %d already done", len(prepared), len(found))
    # monotonic: setting the machine's clock ends no comparison.
    started = time.monotonic()

    def fits(one: PreparedCell) -> bool:
        late = limit_s is not None and time.monotonic() - started + one.expected_s > limit_s
        if late:
            log.warning("max_hours: %s is not started", one.cell)
        return not late

    here = missing if train else []
    work = partial(_tried, run)
    try:
        for number, result in run_each(work, here, "cells", cost=lambda one: one.expected_s, wanted=fits):
            if isinstance(result, str):
                log.warning("%s failed: %s", here[number].cell, result)
                continue
            found[str(result.cell)] = result
            row = result.row
            value = format(row["value"], number_format(row["figure"]))
            log.info("%s: %s %s after %.1f s", result.cell, row["figure"], value, row["train_s"])
    except KeyboardInterrupt:
        message = "interrupted; finished cells are kept: the same command goes on with the others"
        raise KeyboardInterrupt(message) from None
    return [found[str(one.cell)] for one in prepared if str(one.cell) in found]

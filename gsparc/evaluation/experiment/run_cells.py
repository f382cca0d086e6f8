"""The cells of a comparison done: each is a run in a folder of its own, whose summary is its result."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from gsparc.data.executor import run_each
from gsparc.data.files import is_out_of_space
from gsparc.evaluation.console import error_in_one_line
from gsparc.evaluation.experiment.cells import Cell, Contender
from gsparc.evaluation.experiment.problem import Problem, compose
from gsparc.evaluation.ledger import State, is_current, read_finished, run_once
from gsparc.evaluation.metric_formats import number_format
from gsparc.evaluation.results import as_frame, read_run

log = logging.getLogger(__name__)

FREE_S, EFFORT_S = 5.0, 60.0  # guessed for a method that counts nothing; for one of effort 1


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

    def row(self) -> dict[str, Any]:
        """Return the row of its result in the frame, by the names that it has in the comparison."""
        run = read_run(self.folder)
        # The program, not the commit, decides: most commits change nothing that a method computes.
        earlier = "" if is_current(self.folder) else str(run.facts.get("git"))[:8]
        return {
            **run.rows()[0],
            **asdict(self.cell),
            "draws": self.problem.draw is not None,
            "earlier": earlier,
        }


def prepare_cell(
    cell: Cell, contender: Contender, settings: Mapping[str, Any], problem: Problem, cells_dir: Path,
    reuse: bool = False,
) -> PreparedCell:  # fmt: skip
    """Compose a cell's configuration and name its folder, `dataset/split/method/effort/seed`."""
    overrides = [*problem.chosen, *contender.overrides(cell.effort)]
    config = compose(settings, overrides, problem.draw, cell.seed)
    state = State.from_config(config, problem.content, problem.folds.sha256)
    return PreparedCell(cell, problem, config, cells_dir / str(cell), state, reuse)


Fit = Callable[[PreparedCell, str | None], object]


def _tried(fit: Fit, one: PreparedCell) -> str:
    """Why the cell cannot be filled, if so; one failing cell does not stop the table."""
    try:
        run_once(one.folder, one.state, partial(fit, one), reuse=one.reuse)
        return ""
    except Exception as error:  # any error of a plugin
        if is_out_of_space(error):  # the others would be trained in vain
            raise
        unforeseen = not isinstance(error, ValueError | RuntimeError)  # says where it is
        return error_in_one_line(error) + (f"\n{traceback.format_exc()}" if unforeseen else "")


def run_cells(
    prepared: Sequence[PreparedCell], fit: Fit, train: bool = True, limit_s: float | None = None
) -> pd.DataFrame:
    """Return the frame of cells, found or filled now, saying how far it is and how long it will take.

    A cell that cannot be filled is said and left out; the others go on.

    Args:
        prepared: the most wanted first.
        fit: trains a cell into its folder, from what an interrupted try has left there.
        train: whether missing cells are filled.
        limit_s: no cell is started that would end later [s].

    Returns:
        Columns of `results.frame`, those of `Cell`, `draws` (whether its seed is a draw of the split) and
        `earlier` (commit of another program that it was measured with; "" for this one's).
    """
    found = {str(one.cell): one.row() for one in prepared if read_finished(one.folder, one.state, one.reuse)}
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
    work = partial(_tried, fit)
    try:
        for number, why in run_each(work, here, "cells", cost=lambda one: one.expected_s, wanted=fits):
            cell = here[number].cell
            if why:
                log.warning("%s failed: %s", cell, why)
                continue
            found[str(cell)] = row = here[number].row()
            value = format(row["value"], number_format(row["figure"]))
            log.info("%s: %s %s after %.1f s", cell, row["figure"], value, row["train_s"])
    except KeyboardInterrupt:
        message = "interrupted; finished cells are kept: the same command goes on with the others"
        raise KeyboardInterrupt(message) from None
    return as_frame(found[str(one.cell)] for one in prepared if str(one.cell) in found)

"""A list of fits done one after the other in one process, which reads data once; each is kept as it ends."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from gsparc.data.executor import run_each
from gsparc.data.files import is_out_of_space
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.console import error_in_one_line
from gsparc.evaluation.ledger import RECORD, State, edited, read_finished, run_once
from gsparc.evaluation.metric_formats import number_format
from gsparc.evaluation.results import as_frame, read_run, read_summary

log = logging.getLogger(__name__)

REFUSED = "not possible"  # in the error of an effect that the data do not allow


@dataclass(frozen=True)
class Job:
    """One fit of a list: what is asked for, and where its result is.

    Attributes:
        name: a dataclass, whose fields are columns of the frame; the log has its `str`.
        config: what the run is configured by, as composed from conf/train.yaml.
        folder: of the run.
        data, split: measurements and folds.
        content: hash of the measurements, see `measurements_hash`.
        learned: what a fold learns from instead, such as displaced or fewer measurements; `name` says of it.
        expected_s: seconds it may take, guessed [s].
        keeps_models: whether its models stay, to be asked later.
        reuse: whether a result of another program counts, too.
    """

    name: Any
    config: DictConfig
    folder: Path
    data: Measurements
    split: Split
    content: str
    learned: Callable[[Measurements, Fold], tuple[Measurements, Fold]] | None = None
    expected_s: float = 0.0
    keeps_models: bool = True
    reuse: bool = False

    @cached_property
    def state(self) -> State:
        """What its result is to be of."""
        state = State.from_config(self.config, self.content, self.split.sha256)
        own = {} if self.learned is None else {"learned": str(self.name)}
        return replace(state, settings=state.settings | own)

    def row(self) -> dict[str, Any]:
        """Return the row of its result in the frame, by the names that it has in the list."""
        run = read_run(self.folder)
        # The program, not the commit, decides: most commits change nothing that a method computes.
        changed = edited(read_summary(self.folder / RECORD) or {})
        earlier = str(run.facts.get("git"))[:8] if changed else ""
        return {**run.rows()[0], **asdict(self.name), "job": self, "earlier": earlier}


Fit = Callable[[Job, str | None], object]


def _tried(fit: Fit, job: Job) -> str:
    """Why the job cannot be done, if so; one failing job does not stop the table."""
    try:
        run_once(job.folder, job.state, partial(fit, job), reuse=job.reuse)
        return ""
    except Exception as error:  # any error of a plugin
        if is_out_of_space(error):  # the others would be trained in vain
            raise
        unforeseen = not isinstance(error, ValueError | RuntimeError)  # says where it is
        return error_in_one_line(error) + (f"\n{traceback.format_exc()}" if unforeseen else "")


def run_jobs(jobs: Sequence[Job], fit: Fit, train: bool = True, limit_s: float | None = None) -> pd.DataFrame:
    """Return the frame of jobs, found done or done now, saying how far it is and how long it will take.

    A job that cannot be done is said and left out; the others go on.

    Args:
        jobs: the most wanted first.
        fit: trains a job into its folder, from what an interrupted try has left there.
        train: whether missing jobs are done.
        limit_s: no job is started that would end later [s].

    Returns:
        Columns of `results.frame`, those of the jobs' names, `job`, and `earlier` (commit of another program
        that it was measured with; "" for this one's).

    Raises:
        ValueError: none can be done; why the first cannot.
    """
    found = {str(one.name): one.row() for one in jobs if read_finished(one.folder, one.state, one.reuse)}
    missing = [one for one in jobs if str(one.name) not in found]
    log.info("%d cells, %d already done", len(jobs), len(found))
    # monotonic: setting the machine's clock ends no comparison.
    started = time.monotonic()

    def fits(one: Job) -> bool:
        late = limit_s is not None and time.monotonic() - started + one.expected_s > limit_s
        if late:
            log.warning("max_hours: %s is not started", one.name)
        return not late

    here, refused = missing if train else [], dict[str, str]()
    try:
        for number, why in run_each(
            partial(_tried, fit), here, "cells", cost=lambda one: one.expected_s, wanted=fits
        ):
            name = str(here[number].name)
            if why:
                refused[name] = why
                level = logging.INFO if REFUSED in why else logging.WARNING
                log.log(level, "%s is left out: %s", name, why)
                continue
            found[name] = row = here[number].row()
            value = format(row["value"], number_format(row["figure"]))
            log.info("%s: %s %s after %.1f s", name, row["figure"], value, row["train_s"])
    except KeyboardInterrupt:
        message = "interrupted; finished cells are kept: the same command goes on with the others"
        raise KeyboardInterrupt(message) from None
    if refused and not found:
        raise ValueError(next(iter(refused.values())))
    return as_frame(found[str(one.name)] for one in jobs if str(one.name) in found)

"""Lists of jobs, such as fits, done one after the other in one process, which reads data once.

Each fit is kept as it ends; their models are timed at the end, asked in turns,
with nothing beside them.
"""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd
import torch
from omegaconf import DictConfig

from gsparc.base.errors import list_first
from gsparc.base.executor import run_each
from gsparc.base.files import is_out_of_space, write_samples
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.console import error_in_one_line
from gsparc.evaluation.metric_formats import number_format
from gsparc.evaluation.results import as_frame, frame_of_runs, own_rows, read_run, read_summary
from gsparc.evaluation.scores import rows_to_score
from gsparc.models import loading
from gsparc.models.method import Method
from gsparc.prediction import timing
from gsparc.prediction.timing import SPEED, Call, ClockSettings, time_beside_copy
from gsparc.runs.ledger import RECORD, REFUSED, FitInputs, edited, read_finished, run_once
from gsparc.runs.open_runs import open_run

log = logging.getLogger(__name__)

# From here on a method would slow the rounds of the others: it has rounds of its own
SLOW_MS = 200.0
ENDLESS_MS = 10_000.0  # from here on it is timed once
# 60 rounds give a 95th percentile from three samples beyond it.
FAST = ClockSettings(rounds=60, rounds_s=30.0)
SLOW = ClockSettings(rounds=5, least=1, warmup=0, rounds_s=20.0)
ONCE = replace(SLOW, rounds=1)


LONGEST = 3  # jobs that are named before they begin
TIMED = ["dataset", "split", "method", *SPEED[:3]]


@dataclass(frozen=True)
class Job:
    """One fit of a list: what is asked for, and where its result is.

    Attributes:
        name: a dataclass, whose fields are columns of the frame; the log has its `str`.
        config: what the run is configured by, as composed from conf/train.yaml.
        folder: of the run.
        data, split: measurements and folds.
        content: hash of the measurements, see `measurements_hash`.
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
    expected_s: float = 0.0
    keeps_models: bool = True
    reuse: bool = False

    @cached_property
    def state(self) -> FitInputs:
        """What its result is to be of."""
        return FitInputs.from_config(self.config, self.content, self.split.sha256)

    def row(self) -> dict[str, Any]:
        """Return the row of its result in the frame, by the names that it has in the list."""
        run = read_run(self.folder)
        # The program, not the commit, decides: most commits change nothing that a method computes.
        changed = edited(read_summary(self.folder / RECORD) or {})
        earlier = str(run.facts.get("git"))[:8] if changed else ""
        return {**run.rows()[0], **asdict(self.name), "job": self, "earlier": earlier}


Fit = Callable[[Job, str | None], object]


def _duration(seconds: float) -> str:
    """Seconds of a forecast, which is of an idle core, in words."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


Piece = TypeVar("Piece")
Made = TypeVar("Made")


def run_skipping_failures(
    make: Callable[[Piece], Made],
    pieces: Sequence[Piece],
    what: str,
    *,
    name: Callable[[Piece], str] = str,
    refused: list[str] | None = None,
    **how: Any,
) -> Iterator[tuple[Piece, Made]]:
    """Yield each piece with what is made of it, as they end;
    a piece that fails is logged and left out.

    Args:
        make: may raise whatever a plugin does.
        pieces, what, how: see `run_each`.
        name: of a piece in the log.
        refused: a list that takes the reasons of failed pieces.
    """
    for number, (result, why) in run_each(partial(_tried, make), pieces, what, **how):
        if not why:
            yield pieces[number], result
            continue
        log.log(
            logging.INFO if REFUSED in why else logging.WARNING,
            "%s is left out: %s",
            name(pieces[number]),
            why,
        )
        if refused is not None:
            refused.append(why)


def _tried(make: Callable[[Piece], Made], piece: Piece) -> tuple[Any, str]:
    """What is made of a piece, or why that cannot be; one that fails does not stop the others."""
    try:
        return make(piece), ""
    except Exception as error:  # any error of a plugin
        if is_out_of_space(error):  # the others would be made in vain
            raise
        unforeseen = not isinstance(error, ValueError | RuntimeError)  # says where it is
        return None, error_in_one_line(error) + (
            f"\n{traceback.format_exc()}" if unforeseen else ""
        )


def run_jobs(
    jobs: Sequence[Job], fit: Fit, train: bool = True, limit_s: float | None = None
) -> pd.DataFrame:
    """Do the jobs that are not done yet, log how long they take, and return the frame of all.

    A job that fails is logged and left out; the others go on.

    Args:
        jobs: the most wanted first.
        fit: trains a job into its folder, from what an interrupted try has left there.
        train: whether missing jobs are done.
        limit_s: no job is started that would end later [s].

    Returns:
        Columns of `results.frame`, those of the jobs' names, `job`, and `earlier` (commit of
        another program that it was measured with; "" for this one's).

    Raises:
        ValueError: none can be done; why the first cannot.
    """
    rows = {
        str(job.name): job.row() for job in jobs if read_finished(job.folder, job.state, job.reuse)
    }
    missing = [job for job in jobs if str(job.name) not in rows]
    log.info("%d cells, %d already done", len(jobs), len(rows))
    if train and missing:
        total = _duration(sum(job.expected_s for job in missing))
        longest = sorted(missing, key=lambda job: -job.expected_s)
        each = list_first([f"{job.name} {_duration(job.expected_s)}" for job in longest], LONGEST)
        log.info("about %s of an idle core; longest: %s", total, each)
    # monotonic: setting the machine's clock ends no comparison.
    started = time.monotonic()

    def fits(one: Job) -> bool:
        late = limit_s is not None and time.monotonic() - started + one.expected_s > limit_s
        if late:
            log.warning("max_hours: %s is not started", one.name)
        return not late

    waiting, refused = missing if train else [], list[str]()
    try:
        for job, _ in run_skipping_failures(
            lambda job: run_once(job.folder, job.state, partial(fit, job), reuse=job.reuse),
            waiting,
            "cells",
            name=lambda one: str(one.name),
            cost=lambda one: one.expected_s,
            wanted=fits,
            refused=refused,
        ):
            rows[str(job.name)] = row = job.row()
            value = format(row["value"], number_format(row["figure"]))
            log.info("%s: %s %s after %.1f s", job.name, row["figure"], value, row["train_s"])
    except KeyboardInterrupt:
        message = "interrupted; finished cells are kept: the same command goes on with the others"
        raise KeyboardInterrupt(message) from None
    if refused and not rows:
        raise ValueError(refused[0])
    return as_frame(rows[str(job.name)] for job in jobs if str(job.name) in rows)


def time_queries(
    files: Mapping[str, Path], data: Measurements, split: Split, fast: ClockSettings = FAST
) -> dict[str, dict[str, float]]:
    """Return `SPEED` of models by name; slow ones have clocks of their own."""
    methods: dict[str, Method] = {name: loading.load(file)[0] for name, file in files.items()}
    calls = timing.query_calls(methods, data, split.folds[0].test)
    latencies: dict[str, dict[str, float]] = {}

    def timed(names: Iterable[str], clock: ClockSettings) -> None:
        latencies.update(time_beside_copy({name: calls[name] for name in names}, clock))

    # One call sorts them by speed; slow ones take two, as the first may build what later ones keep.
    timed(calls, ONCE)
    timed(
        [
            name
            for name, latency in latencies.items()
            if SLOW_MS < latency["query_ms"] <= ENDLESS_MS
        ],
        ONCE,
    )
    speeds = {name: latency["query_ms"] for name, latency in latencies.items()}
    timed([name for name, ms in speeds.items() if ms <= SLOW_MS], fast)
    timed([name for name, ms in speeds.items() if SLOW_MS < ms <= ENDLESS_MS], SLOW)
    return {name: latencies[name] for name in methods}


def time_by_dataset(filled: pd.DataFrame) -> pd.DataFrame:
    """Return columns `TIMED`, of the first split of each dataset that is there
    and keeps its models.

    Of that alone: models of fewer measurements answer faster. `filled` is the frame of `run_jobs`.
    """
    rows = []
    for dataset, group in filled.groupby("dataset", sort=False):
        fits = group[
            (group.split == group.split.iloc[0]) & group.run.map(lambda run: bool(run.checkpoints))
        ]
        # The first of a method's cells stands for all of its efforts and seeds.
        first = fits.drop_duplicates("method").set_index("method")
        if len(first):
            log.info("%s: timing single queries of every method in turns", dataset)
            files, job = first.run.map(lambda run: run.checkpoints[0]), first.job.iloc[0]
            latencies = time_queries(files.to_dict(), job.data, job.split)
            rows += [
                {**first.loc[name, TIMED[:2]], "method": name, **latency}
                for name, latency in latencies.items()
            ]
    return pd.DataFrame(rows, columns=TIMED)


def time_again(rows: pd.DataFrame, *, rounds: int = 40, rounds_s: float = 60.0) -> pd.DataFrame:
    """Return the frame with the times of single queries,
    which each run's `render_ms.csv` has from now on.

    A sweep runs jobs at the same time, which disturbs their times; call this after it.

    Args:
        rows: those of runs without a readable checkpoint keep the times they have.
        rounds: visits to each.
        rounds_s: no new round after this [s].
    """
    runs, calls, threads = list(own_rows(rows).run), dict[int, Call](), dict[int, int]()
    for number, run in enumerate(runs):
        try:
            opened = open_run(run.checkpoints[:1], {}).read()
            # A folder used twice may hold the model of one run beside the summary of the other.
            if opened.stored[0].extra.get("run_id") != run.facts.get("run_id"):
                raise ValueError("its checkpoint is of another run than its summary")
            tested = rows_to_score(opened.split.folds[0], "test")
            call = opened.predictor.cycle_places(opened.data.moving[tested])
            call(0)  # what reads an uplink answers at no places
        except (ValueError, IndexError) as error:
            log.warning("%s is not timed again: %s", run.folder, error or "it left no checkpoint")
            continue
        calls[number] = call
        threads[number] = int(run.facts.get("machine/threads") or torch.get_num_threads())
    times = timing.time_interleaved(
        calls, replace(timing.BLOCKS, rounds=rounds, rounds_s=rounds_s), threads
    )
    for number, ms in times.items():
        write_samples(runs[number].folder / "render_ms.csv", {"render_ms": ms})
    return frame_of_runs(read_run(run.folder) for run in runs)

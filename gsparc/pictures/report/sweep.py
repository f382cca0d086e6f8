"""The end of a multirun: failures reported at once, models timed alone, a table and a figure."""

from __future__ import annotations

import logging
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import Console

from gsparc.base.errors import list_first
from gsparc.evaluation import summary
from gsparc.evaluation.console import error_in_one_line, open_console
from gsparc.evaluation.provenance import provenance
from gsparc.runs.experiment.options import REDRAW
from gsparc.runs.ledger import FAILURE, REFUSED

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

SCORED = ("test/", "val/", "train/")  # figures that settings are compared by
WIDE = ("SSIM (uniform 7)", "MSE", "p95", "median PSNR dB", "median MSE")  # left to the files


class SweepReport(Callback):
    """A Hydra callback: does nothing in a single run.

    Args:
        retime: time the models of the sweep when all jobs are done, in turns, with nothing beside
            them.
        rounds: visits to each model by the clock.
        rounds_s: no new round after this [s].
        pictures: drawn beside `sweep.png`, names of `confidence_pictures.PICTURES`.
    """

    def __init__(
        self,
        retime: bool = True,
        rounds: int = 40,
        rounds_s: float = 60.0,
        pictures: Sequence[str] = (),
    ) -> None:
        self.retime, self.rounds, self.rounds_s, self.pictures = retime, rounds, rounds_s, pictures

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **unused: Any) -> None:
        """Report a failure when it happens; the sweep goes on, and ends with exit status 1."""
        if config.hydra.mode != RunMode.MULTIRUN or job_return.status != JobStatus.FAILED:
            return
        error = job_return._return_value
        message = error_in_one_line(error) if isinstance(error, BaseException) else str(error)
        folder = Path(config.hydra.runtime.output_dir)
        job = f"job {folder.name} ({' '.join(config.hydra.overrides.task)})"
        if REFUSED in message:  # an effect, by these data
            log.warning("%s is left out: %s", job, message)
        else:
            # The mark that `on_multirun_end` counts failures by:
            # other processes' jobs are seen as files alone.
            (folder / FAILURE).write_text(message + "\n", encoding="utf-8")
            # The console shows the sentence, the job's own log the traceback, too.
            log.error("%s failed, others go on: %s", job, message, exc_info=error)
        # Hydra raises the first failed job's error and ends the sweep:
        # it is told that the job ended well.
        job_return.status = JobStatus.COMPLETED
        job_return.return_value = None

    def on_multirun_end(self, config: DictConfig, **unused: Any) -> None:
        """Time, tabulate and draw what the sweep made."""
        folder = Path(config.hydra.sweep.dir)
        failed = sorted(folder.rglob(FAILURE))
        console = open_console()
        if any(path.parent != folder for path in folder.rglob("summary.json")):
            report_sweep(folder, str(config.get("title") or folder.name), console, self)
        if failed:
            names = ", ".join(path.parent.name for path in failed)
            console.print(f"error: {len(failed)} jobs failed: {names}", style="red", markup=False)
            # Hydra itself ends with 0 here.
            sys.exit(1)


def report_sweep(folder: Path, title: str, console: Console, settings: SweepReport) -> None:
    """Write `sweep.csv`, `sweep.png`, `report.html` and `summary.json` of a sweep's directory,
    and its table.
    """
    # Here, as they take half a second, and a mistyped option is to be named at once.
    from gsparc.evaluation.results import frame, own_rows
    from gsparc.pictures import plots
    from gsparc.pictures.confidence_pictures import draw_confidences
    from gsparc.pictures.report.page import write_report
    from gsparc.pictures.report.tables import table_of_leads, table_of_seeds
    from gsparc.runs.experiment.runner import time_again

    rows = frame(folder)
    if settings.retime:
        rows = time_again(rows, rounds=settings.rounds, rounds_s=settings.rounds_s)
    for number, section in enumerate(write_report(folder, title, rows)):
        group, fits = section.rows, own_rows(section.rows)
        stem = "sweep" if number == 0 else f"sweep-{number + 1}"
        table = table_of_seeds(group)
        (folder / f"{stem}.csv").write_text(table.csv(), encoding="utf-8")
        plots.draw_sweep(group, f"{title}: {section.title}", folder / f"{stem}.png")
        draw_confidences(
            settings.pictures, group, section.title, folder, stem.removeprefix("sweep")
        )
        console.print(
            *(
                shown_table.without(*WIDE)
                for shown_table in (table, table_of_leads(group))
                if shown_table.rows
            )
        )
        seeds = {run.config.get("split.seed") for run in fits.run}
        if fits.split.iloc[0] == "random" and len(seeds) > 1 == fits.draw.nunique():
            log.warning("split.seed moves validation rows alone: %s", REDRAW)
        for same in equal_settings(fits):
            console.print(f"these settings gave the same figures to the bit: {same}", markup=False)
    facts = {"sweep/runs": len(own_rows(rows)), **provenance()}
    summary.write_summary(folder / "summary.json", facts)
    console.print(f"written to {folder}", highlight=False)


def equal_settings(own: pd.DataFrame) -> list[str]:
    """Return settings of rows with their `run` that have equal figures,
    one line for those that agree.
    """
    alike: dict[str, list[str]] = defaultdict(list)
    for setting, runs in own.groupby("setting", sort=False).run:
        figures = (
            sorted(fact for fact in run.facts.items() if fact[0].startswith(SCORED)) for run in runs
        )
        alike[repr(sorted(map(repr, figures)))].append(str(setting))
    return [list_first(names) for names in alike.values() if len(names) > 1]

"""`gsparc compare`: methods x datasets x splits by effort, one table, one figure."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from gsparc.base.files import platform_cache, write_samples
from gsparc.commands.train import train_job
from gsparc.evaluation.examples import join_examples
from gsparc.evaluation.provenance import provenance
from gsparc.evaluation.summary import write_summary
from gsparc.pictures.drawing import PRINTED, save
from gsparc.pictures.pictures import draw_spectra
from gsparc.pictures.plots import draw_accuracy_over_cost, draw_splits, draw_sweep
from gsparc.runs.experiment.cells import plan_jobs
from gsparc.runs.experiment.published import beside_published, read_published
from gsparc.runs.experiment.runner import run_jobs, time_by_dataset
from gsparc.runs.experiment.table import (
    CELL,
    PROBLEM,
    average_cells,
    columns_of_csv,
    markdown,
    remarks,
    split_by_problem,
    table_of,
    title_of,
)
from gsparc.runs.output import CommandCall, command, show_result
from gsparc.runs.run_lock import locked

log = logging.getLogger(__name__)


@command()
def task(call: CommandCall) -> pd.DataFrame:
    """Compare as conf/compare.yaml says, see `compare`."""
    return compare(call.given, call.folder)


def compare(settings: Mapping[str, Any], run_dir: Path) -> pd.DataFrame:
    """Fill the cells that are asked for and not there yet, then time all methods and report.

    Args:
        settings: those of conf/compare.yaml.
        run_dir: where tables and pictures are written.

    Returns:
        The rows of `average_cells`.
    """
    for form in settings["figures"]:  # now: the pictures come after hours of training
        PRINTED.check("figures", form)
    published = read_published(settings["beside"]) if settings["beside"] else None
    folder = settings["cells"]
    cells_dir = Path(os.path.expanduser(folder)) if folder else platform_cache() / "comparison"
    jobs = plan_jobs(settings, cells_dir)
    limit_s = None if settings["max_hours"] is None else float(settings["max_hours"]) * 3600
    log.info("cells are in %s", cells_dir)
    # The folder of cells is shared by all comparisons here: two would fill the same ones.
    with locked(cells_dir, "cells"):
        filled = run_jobs(jobs, train_job, bool(settings["train"]), limit_s)
    if filled.empty:
        raise ValueError("no cell is filled: nothing to report (train=true fills them)")
    timed = time_by_dataset(filled) if settings["latency"] else None
    return write_comparison(
        filled, timed, str(settings["ours"]), run_dir, settings["figures"], published
    )


def write_comparison(
    filled: pd.DataFrame,
    timed: pd.DataFrame | None,
    ours: str,
    run_dir: Path,
    figures: Sequence[str] = (),
    published: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """Write `compare.csv`, `cells.csv`, `compare.md`, `summary.json` and pictures,
    and show the page.

    `figures` are formats beside PNG, see `drawing.save`; `published`: rows that stand beside, see
    `read_published`.

    Splits that are drawn several times have a picture per dataset, all others are panels of
    `compare.png`; each has the distributions of its methods' errors,
    and of spectra the same rows as all predict them.
    """
    rows = average_cells(filled, timed)
    rows = rows if published is None else beside_published(rows, published)
    blocks = split_by_problem(rows)
    write_samples(run_dir / "compare.csv", columns_of_csv(rows))
    write_samples(run_dir / "cells.csv", filled[CELL].to_dict("list"))
    (run_dir / "compare.md").write_text(markdown(blocks, ours), encoding="utf-8")
    for dataset, group in rows[rows.draws].groupby("dataset", sort=False):
        draw_splits(group, run_dir / f"{dataset}.png", figures)
    if not rows.draws.all():
        draw_accuracy_over_cost(rows[~rows.draws], run_dir / "compare.png", ours, figures)
    # Of a method's efforts the largest.
    most = filled.sort_values("effort", kind="stable").drop_duplicates(
        [*PROBLEM, "method", "seed"], keep="last"
    )
    for (dataset, split), group in most.assign(setting=most.method).groupby(PROBLEM, sort=False):
        title, stem = f"{dataset}, split {split}", f"{dataset}-{split}"
        draw_sweep(group, title, run_dir / f"{stem}-distributions.png", figures)
        if (examples := join_examples(group)) is not None:
            save(draw_spectra(examples, title), run_dir / f"{stem}-rows.png", 100, figures)
    best = {f"{title_of(block)}/first": block.method.iloc[0] for block in blocks}
    write_summary(run_dir / "summary.json", {"cells": len(filled), **best, **provenance()})
    parts: list[Any] = [
        part for block in blocks for part in (table_of(block, ours), *remarks(block, ours))
    ]
    show_result(run_dir, *parts)
    return rows

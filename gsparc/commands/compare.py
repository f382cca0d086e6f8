"""`gsparc compare`: methods x datasets x splits under equal budgets, one table, one figure."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig
from rich.markdown import Markdown

from gsparc.commands.shared.output import run_directory, show
from gsparc.commands.shared.run_lock import locked
from gsparc.commands.shared.settings import RunSettings, plain
from gsparc.commands.train import read_inputs, train
from gsparc.data.files import platform_cache
from gsparc.evaluation.drawing import PRINTED
from gsparc.evaluation.experiment.cells import Budget, Contender, plan, plugged
from gsparc.evaluation.experiment.fitting import CellResult, PreparedCell, prepare_cell, run_cells
from gsparc.evaluation.experiment.latency import Latency, timed_here
from gsparc.evaluation.experiment.pictures import draw_budgets, draw_splits
from gsparc.evaluation.experiment.problem import named, problems_of
from gsparc.evaluation.experiment.table import CELL, blocks_of, cells_of, markdown, rows_of
from gsparc.evaluation.summary import provenance, write_samples, write_summary


def task(config: DictConfig) -> pd.DataFrame:
    """Fill the cells that are asked for and not there yet, then time all methods and report."""
    RunSettings.of(config)
    run_dir = run_directory()
    settings = plain(config)
    for form in settings["figures"]:  # now: the pictures come after hours of training
        PRINTED.check("figures", form)
    methods = plugged() | named("methods", Contender, settings["methods"])
    folder = settings["cells"]
    cells_dir = Path(os.path.expanduser(folder)) if folder else platform_cache() / "comparison"
    problems = problems_of(settings)
    budgets = [
        Budget(float(b["seconds"]), tuple(map(int, b["seeds"])), tuple(b.get("splits") or ()))
        for b in settings["budgets"]
    ]
    own = {name: of or {} for name, of in settings["datasets"].items()}
    prepared = [
        prepare_cell(cell, methods[cell.method], own[cell.dataset], problem, cells_dir, settings["reuse"])
        for problem, cell in plan(problems, methods, budgets, settings["only"])
    ]
    limit_s = None if settings["max_hours"] is None else float(settings["max_hours"]) * 3600
    # The folder of cells is shared by all comparisons here: two would fill the same ones.
    with locked(cells_dir, "cells"):
        filled = run_cells(prepared, run, bool(settings["train"]), limit_s)
    if not filled:
        raise ValueError("no cell is filled: nothing to report (train=true fills them)")
    by_name = {(r.dataset, r.split): r for r in reversed(problems)}  # the first draw of each
    timed = timed_here(filled, by_name) if settings["latency"] else {}
    return report(filled, timed, str(settings["ours"]), run_dir, settings["figures"])


def run(one: PreparedCell, left: str | None) -> None:
    """Train a cell into its folder; of a split that is drawn several times, models of the first are kept."""
    config = deepcopy(one.config)
    # What an interrupted try has left is gone on from, unless the settings name something else.
    config.ckpt_path = config.ckpt_path or left
    _, made = train(config, one.folder, read_inputs(config, one.problem.data), in_full=False)
    for file in made.checkpoints if one.problem.draw else ():  # queries are timed with those of the first
        file.unlink()


def report(
    filled: Sequence[CellResult], timed: Mapping[str, Mapping[str, Latency]], ours: str, run_dir: Path,
    figures: Sequence[str] = (),
) -> pd.DataFrame:  # fmt: skip
    """Write `compare.csv`, `cells.csv`, `compare.md`, `summary.json` and pictures, and show the page.

    `figures` are formats beside PNG, see `drawing.save`.

    Splits that are drawn several times have a picture per dataset, all others are panels of `compare.png`.
    """
    rows = rows_of(filled, timed)
    blocks = blocks_of(rows)
    by_draw = rows[rows.draws]
    by_set = [here for _, here in by_draw.groupby("dataset", sort=False)]
    page = markdown(blocks, ours)
    write_samples(run_dir / "compare.csv", rows.to_dict("list"))
    write_samples(run_dir / "cells.csv", cells_of(filled)[CELL].to_dict("list"))
    (run_dir / "compare.md").write_text(page, encoding="utf-8")
    for here in by_set:
        draw_splits(here, run_dir / f"{here.dataset.iloc[0]}.png", figures)
    if not rows.draws.all():
        draw_budgets(rows[~rows.draws], run_dir / "compare.png", ours, figures)
    facts: dict[str, Any] = {"cells": len(filled), **provenance()}
    for block in blocks:
        budget = block.budget_s.max()
        name = "any" if math.isnan(budget) else f"{budget:g}"
        stem = f"{block.dataset.iloc[0]}/{block.split.iloc[0]}/{name}"
        facts[f"{stem}/first"] = block.method.iloc[0]
        for row in block.itertuples():
            # JSON has no NaN: a method whose queries were not timed has null.
            query_ms = None if math.isnan(row.query_ms) else row.query_ms
            own = {"score_db": row.score_db, "train_s": row.train_s, "query_ms_p50": query_ms}
            facts |= {f"{stem}/{row.method}/{name}": value for name, value in own.items()}
    write_summary(run_dir / "summary.json", facts)
    show(run_dir, Markdown(page))
    return rows

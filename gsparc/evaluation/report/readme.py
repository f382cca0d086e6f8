"""The results table of a document, written by a command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsparc.data.files import whole_file
from gsparc.evaluation.report.runs import Run, by_study
from gsparc.evaluation.report.table import Table
from gsparc.evaluation.report.tables import results, seeds

BEGIN = "<!-- results: written by `make results` -->"
END = "<!-- end of results -->"
OMITTED_COLUMNS = ("SSIM (uniform 7)", "MSE", "p95", "Gaussians")  # columns for the report's page
OMITTED_ROWS = ("zero",)  # rows likewise


def refresh(path: Path, runs: Sequence[Run]) -> None:
    """Replace what stands between the marks `BEGIN` and `END`; the file is replaced whole.

    Raises:
        ValueError: the marks are missing or in the wrong order.
    """
    text = path.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{path}: the lines {BEGIN} and {END} are needed, in this order")
    with whole_file(path) as partial:
        partial.write_text(f"{before}{BEGIN}\n\n{tables(runs)}\n{END}{after}", encoding="utf-8")


def tables(runs: Sequence[Run]) -> str:
    """A short table per study: settings over seeds, then the baselines."""
    groups = by_study(runs).items()
    return "\n".join(_short(f"{name}, split {split}", group) for (name, split), group in groups)


def _short(title: str, runs: Sequence[Run]) -> str:
    runs = [replace(run, render_ms=np.zeros(0)) for run in runs]  # on the clock that timed the baselines
    table, whole, facts = seeds(runs), results(runs), runs[0].facts
    names, heads = ([column.name for column in one.columns] for one in (table, whole))
    rows = list(table.rows)
    for row in whole.rows[len(runs) :]:  # the baselines have no seeds
        cells = dict(zip(heads, row, strict=True))
        if row[0] not in OMITTED_ROWS:
            rows.append([cells.get(name) for name in names])
    load = max((float(run.facts.get("machine/load") or 0) for run in runs), default=0.0)
    machine = f"{facts.get('machine/cpu')}, {facts.get('machine/threads')} thread(s)"
    note = f"{machine}, load {load:.1f} per core; queries in turns."
    kept = [i for i, name in enumerate(names) if name not in OMITTED_COLUMNS]
    short = [[row[i] for i in kept] for row in rows]
    return Table(title, [table.columns[i] for i in kept], short, note).markdown()

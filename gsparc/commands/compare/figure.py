"""Accuracy against what it costs: a line of panels per dataset, a panel per split, queries at the end.

Processor time of training, because a busy machine stretches the clock and not the work.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.artist import Artist

from gsparc.commands.compare.table import SCORE, Row
from gsparc.evaluation.drawing import logarithmic, look, panels, save

LEAST_S = 1e-3  # faster fits are drawn here
PANEL = 2.4  # inches


def draw(rows: Sequence[Row], path: Path, ours: str) -> None:
    """A method looks the same in all panels; a line joins its budgets.

    Args:
        rows: of the splits that are not drawn several times.
        path: PNG file.
        ours: the method with the largest mark.
    """
    datasets = list(dict.fromkeys(row.dataset for row in rows))
    splits = {name: list(dict.fromkeys(r.split for r in rows if r.dataset == name)) for name in datasets}
    columns = max(map(len, splits.values())) + any(row.query_ms for row in rows)
    size = (max(PANEL * columns, 6.0), 0.9 * PANEL * len(datasets) + 0.9)
    figure, grid = panels(*size, len(datasets), columns, sharey="row")
    for line, dataset in zip(grid, datasets, strict=True):
        here = [row for row in rows if row.dataset == dataset]
        for axis, split in zip(line, splits[dataset], strict=False):
            _panel(axis, [row for row in here if row.split == split], "train_cpu_s", ours)
            axis.set(title=f"{dataset}, {split}", xlabel="training, CPU [s]")
        line[0].set_ylabel(SCORE[here[0].figure])
        free = line[len(splits[dataset]) :]
        timed = [row for row in here if row.split == splits[dataset][0] and row.query_ms is not None]
        if timed:
            _panel(free[0], timed, "query_ms", ours)
            free[0].set(title=f"{dataset}, {splits[dataset][0]}", xlabel="one query [ms]")
        for axis in free[1 if timed else 0 :]:
            axis.set_visible(False)
    handles: dict[str, Artist] = {}
    for axis in grid.flat:
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    figure.legend(
        list(handles.values()), list(handles), loc="outside lower center", ncols=min(6, 2 * columns)
    )
    save(figure, path)


def _panel(axis: Any, rows: Sequence[Row], horizontal: str, ours: str) -> None:
    for name in dict.fromkeys(row.method for row in rows):
        own: Iterable[Row] = sorted((r for r in rows if r.method == name), key=lambda r: r.budget_s or 0)
        known = [(getattr(r, horizontal), r.score_db, r.spread_db or 0.0) for r in own]
        points = [(max(x, LEAST_S), *rest) for x, *rest in known if x is not None]
        if points:
            style = look(name).marked | {"markersize": 11 if name == ours else 6, "capsize": 2}
            axis.errorbar(*zip(*points, strict=True), label=name, **style)
    logarithmic(axis, fine=False)

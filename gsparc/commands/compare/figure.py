"""Accuracy against what it costs: processor time of training on the left, one query on the right.

Processor time, because a busy machine stretches the clock and not the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.artist import Artist

from gsparc.commands.compare.table import SCORE, Row
from gsparc.evaluation.drawing import logarithmic, panels, save

LEAST_S = 1e-3  # faster fits are drawn here
MARKS = "osD^vP*X<>ph"


def draw(rows: Sequence[Row], path: Path, ours: str) -> None:
    """A line of panels per dataset and split; a method keeps its colour, a line joins its budgets."""
    problems = list(dict.fromkeys((r.dataset, r.split) for r in rows))
    names = list(dict.fromkeys(r.method for r in rows))
    palette = matplotlib.colormaps["tab20"]
    styles = {name: (palette((2 * i + i // 10) % 20), MARKS[i % len(MARKS)]) for i, name in enumerate(names)}
    figure, grid = panels(11, 3.4 * len(problems) + 0.6, len(problems), 2, sharey="row")
    for line, (dataset, split) in zip(grid, problems, strict=True):
        here = [r for r in rows if (r.dataset, r.split) == (dataset, split)]
        for name in names:
            colour, mark = styles[name]
            own = sorted((r for r in here if r.method == name), key=lambda r: r.budget_s or 0)
            style = {"color": colour, "marker": mark, "markersize": 11 if name == ours else 7, "capsize": 2}
            for axis, horizontal in zip(line, ("train_cpu_s", "query_ms"), strict=True):
                points = [
                    (max(x, LEAST_S), r.score_db, r.spread_db or 0.0)
                    for r in own
                    if (x := getattr(r, horizontal)) is not None
                ]
                if points:
                    axis.errorbar(*zip(*points, strict=True), label=name, **style)
        line[0].set_ylabel(SCORE[here[0].figure])
        line[0].set_title(f"{dataset}, split {split}", loc="left", fontsize=10)
        line[0].set_xlabel("training of one model, processor time [s]")
        line[1].set_xlabel("one query, median [ms]")
        for axis in line:
            logarithmic(axis)
        if not any(r.query_ms for r in here):
            line[1].set_visible(False)
    handles: dict[str, Artist] = {}
    for axis in grid.flat:
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=7, fontsize=9)
    save(figure, path)

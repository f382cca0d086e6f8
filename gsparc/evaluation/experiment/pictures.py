"""Comparisons and studies drawn: accuracy against cost, error bars over draws, accuracy against an error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from gsparc.evaluation.drawing import panels, save, set_log_axis, style_of
from gsparc.evaluation.experiment.table import methods_by_mean_behind, shown
from gsparc.evaluation.metric_formats import axis_of, lower_is_better, score_heading

# Fits that only keep rows take microseconds: decades of a logarithmic axis for them alone.
LEAST_S = 1e-3  # faster fits are drawn here
PANEL = 2.4  # inches


def draw_efforts(rows: pd.DataFrame, path: Path, ours: str, also: Sequence[str] = ()) -> None:
    """Save accuracy against costs, see `save`: a line joins the efforts; `ours` has a large mark.

    `rows` are as of `average_cells`.
    """
    groups = [here for _, here in rows.groupby("dataset", sort=False)]
    columns = max(here.split.nunique() for here in groups) + bool(rows.query_ms.any())
    size = (max(PANEL * columns, 6.0), 0.9 * PANEL * len(groups) + 0.9)
    figure, grid = panels(*size, len(groups), columns, sharey="row")
    for line, here in zip(grid, groups, strict=True):
        splits = [(own, "train_cpu_s", split) for split, own in here.groupby("split", sort=False)]
        first = splits[0][0]
        wanted = [*splits, *([(first, "query_ms", "queries")] if first.query_ms.notna().any() else [])]
        for axis, (own, horizontal, shows) in zip(line, wanted, strict=False):
            _panel(axis, own, horizontal, ours)
            label = "training, CPU [s]" if horizontal == "train_cpu_s" else "one query [ms]"
            axis.set(title=f"{here.dataset.iloc[0]}, {shows}", xlabel=label)
        line[0].set_ylabel(score_heading(first.figure.iloc[0]))
        if lower_is_better(first.figure.iloc[0]):
            line[0].invert_yaxis()  # of the whole line: better is up in every panel
        for axis in line[len(wanted) :]:
            axis.set_visible(False)
    # Lines with their marks: an `errorbar` would be shown with bars that no point has.
    handles = [Line2D([], [], label=name, **style_of(name).marked) for name in rows.method.unique()]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(6, 2 * columns))
    save(figure, path, also=also)


def _panel(axis: Any, rows: pd.DataFrame, horizontal: str, ours: str) -> None:
    for name, own in rows.dropna(subset=horizontal).groupby("method", sort=False):
        own = own.sort_values("effort", na_position="first")
        style = style_of(str(name)).marked | {"markersize": 11 if name == ours else 6, "capsize": 2}
        x, spread = own[horizontal].clip(lower=LEAST_S), own.spread_db.fillna(0.0)
        level = [shown(*one) for one in zip(own.figure, own.score_db, strict=True)]
        axis.errorbar(x, level, spread, label=name, **style)
    set_log_axis(axis, 1.5)


LINE = 0.34  # height of a method [inch]


def draw_splits(rows: pd.DataFrame, path: Path, also: Sequence[str] = ()) -> None:
    """Save a panel per split: mean and standard error over draws, of `average_cells` of one dataset."""
    splits, names = list(rows.split.unique()), list(methods_by_mean_behind(rows))
    figure, grid = panels(2.2 + 3.1 * len(splits), 1.3 + LINE * len(names), 1, len(splits), sharey=True)
    for axis, split in zip(grid[0], splits, strict=True):
        here = rows[rows.split == split].drop_duplicates("method", keep="last")  # the largest effort
        here = here.fillna({"value_error": 0.0}).set_index("method")
        most = (here.value + here.value_error).max()
        best = here.score_db.idxmax()
        for number, name in enumerate(names):
            if name not in here.index:
                axis.text(0.02 * most, number, "not possible", va="center", fontsize=8, color="0.5")
                continue
            row = here.loc[name]
            bar = {"color": style_of(name).colour, "alpha": 1.0 if name == best else 0.45, "capsize": 2.5}
            axis.barh(number, row.value, xerr=row.value_error, **bar)
            axis.text(
                min(row.value + row.value_error + 0.02 * most, 1.02 * most), number,
                f"{row.value:.3g}, fit {_seconds(row.train_s)}", va="center", fontsize=7.5,
            )  # fmt: skip
        draws = int(here.seeds.max())
        axis.set(title=f"{split}, {draws} draw{'s' * (draws > 1)}", xlim=(0, 1.5 * most))
        axis.set_xlabel(axis_of(here.figure.iloc[0]))
        axis.set_yticks(np.arange(len(names)), names)
        axis.grid(axis="y", visible=False)
    grid[0, 0].set_ylim(len(names) - 0.4, -0.6)
    name = rows.dataset.iloc[0]
    figure.suptitle(f"{name}: mean and standard error over draws of the split; the best is dark")
    save(figure, path, also=also)


def _seconds(value: float) -> str:
    if value < 0.1:
        return f"{1e3 * value:.2g} ms"
    return f"{value:.2g} s" if value < 10 else f"{value:.0f} s"


TRAINING = "training of one model [s]"
ACCURACY = "value"
# Condition whose rows are drawn, label of the horizontal axis, its column and factor, column of the vertical.
PANELS = (
    ("query", "position error in queries [cm]", "amount", 100, ACCURACY),
    ("train", "position error in training [cm]", "amount", 100, ACCURACY),
    ("train_known", "the same, its size known [cm]", "amount", 100, ACCURACY),
    ("directions", "error of directions of arrival [degrees]", "amount", 1, ACCURACY),
    ("keep", "measurements learned from", "rows", 1, ACCURACY),
    ("keep", "measurements learned from", "rows", 1, "train_s"),
    ("none", TRAINING, "train_s", 1, ACCURACY),
    ("none", "one query, median [ms]", "query_ms", 1, ACCURACY),
)


def draw_study(rows: pd.DataFrame, title: str, path: Path) -> None:
    """Save the rows of `average_rounds` as PNG; a dotted line: the accuracy on undisturbed data."""
    changes = set(rows.what) - {"none"} or {"none"}  # costs alone where nothing was changed
    wanted = [panel for panel in PANELS if panel[0] in changes]
    figure, grid = panels(5 * len(wanted), 4, 1, len(wanted))
    figure.suptitle(title, fontsize=11)
    name = rows.figure.iloc[0]
    for axes, (what, label, x, factor, y) in zip(grid[0], wanted, strict=True):
        for variant, own in rows.groupby("variant", sort=False):
            clean, own = own[own.what == "none"], own[own.what == what]
            if own.empty:
                continue
            spread = own.spread.fillna(0.0) if y == ACCURACY else None
            line, *_ = axes.errorbar(factor * own[x], own[y], spread, marker="o", capsize=2, label=variant)
            if len(clean) and what != "none" and y == ACCURACY:
                axes.axhline(clean.value.iloc[0], color=line.get_color(), linestyle=":", linewidth=1)
        set_log_axis(axes)
        axes.set(xlabel=label, ylabel=name if y == ACCURACY else TRAINING)
        if y != ACCURACY:
            axes.set_yscale("log")
        elif lower_is_better(name):
            axes.invert_yaxis()
    grid[0, 0].legend(fontsize=8)
    save(figure, path)

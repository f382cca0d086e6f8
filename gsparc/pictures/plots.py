"""Frames of results drawn: runs, comparisons, studies, trade-offs;
accuracy beside what it costs.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gsparc.evaluation.metric_formats import (
    OF_KIND,
    axis_of,
    heading_of,
    is_power_ratio,
    lower_is_better,
    score_heading,
    score_of,
)
from gsparc.evaluation.results import Run, average, distinct_baselines, own_rows
from gsparc.evaluation.table import Row
from gsparc.pictures.drawing import (
    numbered_style,
    panels,
    save,
    set_latency_axes,
    set_log_axis,
    style_of,
)
from gsparc.pictures.report.tables import groups_of, interval_of_figure
from gsparc.prediction.operating_point import pareto_front
from gsparc.runs.experiment.table import methods_by_mean_behind, shown

WIDE, TALL = 7.0, 3.8
BAND = 0.95
TIMES = "render_ms"  # of single queries, beside the figures of samples


def to_svg(figure: Figure) -> str:
    """Return the figure as an SVG element, without the XML head; text stays text."""
    out = io.StringIO()
    # Text as text is searched and scaled; a fixed salt and no date give equal files for equal runs.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "gsparc"}):
        FigureCanvasSVG(figure).print_svg(out, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    # An XML head inside a page is an error of HTML.
    return text[text.index("<svg") :]


def draw_pareto(rows: pd.DataFrame, fronts: Sequence[dict[str, np.ndarray]] = ()) -> Figure:
    """Test accuracy against latency: runs with intervals, baselines, swept fronts,
    and the Pareto front.
    """
    figure, ((axes,),) = panels(WIDE, TALL)
    name = rows.figure.iloc[0]
    points: list[tuple[float, float]] = []
    for setting, group, style in _styled(rows):
        for number, row in enumerate(group):
            p50, p95 = row["query_ms"], row["query_p95_ms"]
            estimate = interval_of_figure(row, name)
            if p50 is None or estimate is None:
                continue
            axes.errorbar(
                [p50],
                [estimate.value],
                xerr=[[0.0], [max((p95 or p50) - p50, 0.0)]],
                yerr=estimate.bars,
                fmt="o",
                ms=4,
                lw=0.7,
                color=style["color"],
                label=None if number else setting,
            )
            points.append((p50, estimate.value))
    others = [(base["method"], base["query_ms"], base["value"]) for base in _rivals(rows)]
    others = [other for other in others if other[1] is not None]
    points += [other[1:] for other in others]
    for columns in fronts:
        if name in columns:
            x, y = (columns[key][columns["front"] == 1] for key in ("render_ms_p50", name))
            axes.plot(x, y, ".-", lw=0.8, c="k", label="swept front")
    best = pareto_front([x for x, _ in points], [score_of(name, y) for _, y in points])
    x, y = [points[i][0] for i in best], [points[i][1] for i in best]
    axes.step(x, y, where="post", lw=0.6, c="0.7", label="Pareto front")
    set_latency_axes(axes, name, [value for _, value in points], others)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles, [shorten_setting(label, 44) for label in labels], fontsize=6.5)
    figure.set_label("Accuracy against latency (95 % intervals)")
    return figure


def draw_distributions(
    rows: pd.DataFrame, names: Sequence[str], labels: Mapping[str, str] = MappingProxyType({})
) -> Figure:
    """Draw the shares of test samples that are at most so good, per setting over its seeds,
    a panel a figure.

    Dashed lines are medians. With the band that the whole curve lies in at 95 % (Dvoretzky, Kiefer
    and Wolfowitz 1956; Massart): seeds share their test samples, whose number counts once. `TIMES`
    among `names` are single queries.
    """
    figure, ((*line,),) = panels(max(4.2 * len(names), WIDE), TALL, 1, len(names))
    for axes, name in zip(line, names, strict=True):
        for setting, group, style in _styled(rows):
            samples = [_values_of(row["run"], name) for row in group]
            samples = [values[np.isfinite(values)] for values in samples]
            count = max(map(len, samples)) if name != TIMES else sum(map(len, samples))
            values, share = _shares(samples)
            # DKW: P(sup |F_n - F| > e) <= 2 exp(-2 n e^2), Massart 1990 for the constant 2.
            half = np.sqrt(np.log(2 / (1 - BAND)) / (2 * max(count, 1)))
            axes.step(
                values, share, where="post", lw=1.2, label=labels.get(setting, setting), **style
            )
            low, high = np.clip(share - half, 0, 1), np.clip(share + half, 0, 1)
            axes.fill_between(
                values, low, high, step="post", color=style["color"], alpha=0.08, lw=0
            )
            axes.axvline(
                np.median(values) if len(values) else np.nan, lw=0.8, ls="--", color=style["color"]
            )
        for method, draws in _samples_of_rivals(rows, name).items():
            line_of = style_of(method).line
            axes.step(*_shares(draws), lw=0.8, label=method, **line_of)
            axes.axvline(np.median(np.concatenate(draws)), lw=0.6, ls="--", color=line_of["color"])
        axes.set_xlabel(
            "one query, alone [ms]" if name == TIMES else f"{heading_of(name)} of a test sample"
        )
        if name == TIMES or is_power_ratio(name):
            set_log_axis(axes, np.inf if name == TIMES else 0.0)
    line[0].set_ylabel("share of samples")
    handles, texts = line[0].get_legend_handles_labels()
    figure.legend(
        handles, [shorten_setting(text, 90) for text in texts], loc="outside lower center", ncols=2
    )
    figure.set_label("How the accuracy is distributed (95 % bands, dashed: medians)")
    return figure


def draw_sweep(rows: pd.DataFrame, title: str, path: Path, also: Sequence[str] = ()) -> None:
    """Save the figure that ends a sweep: distributions over test samples and of single queries,
    see `save`.

    The paper's ablations draw the same: SSIM, PSNR, squared error, render time.
    """
    fits = own_rows(rows)
    names = [
        name
        for name in OF_KIND[fits.kind.iloc[0]].distributions
        if name in fits.run.iloc[0].samples
    ]
    names += [TIMES] if any(len(run.render_ms) for run in fits.run) else []
    if not names:  # nothing was tested
        return
    labels = {}
    for setting, seconds, ms in average(fits, ["setting"], ["train_s", "query_ms"])[
        "mean"
    ].itertuples():
        labels[setting] = f"{shorten_setting(setting, 40)}: training {seconds:.3g} s"
        if np.isfinite(ms):
            labels[setting] += f", one query {ms:.3g} ms"
    figure = draw_distributions(rows, names, labels)
    figure.suptitle(title, fontsize=9)
    save(figure, path, 100, also)


def _shares(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All values (n,) sorted, and the share of them that each is at least as large as."""
    values = np.sort(np.concatenate(parts))
    return values, np.arange(1, len(values) + 1) / len(values)


def _values_of(run: Run, name: str) -> np.ndarray:
    """A per-sample figure (n,) of a run, empty where it has none; an error by its size."""
    values = run.render_ms if name == TIMES else run.samples.get(name, np.zeros(0))
    return np.abs(values) if name == "error_db" else values


def _samples_of_rivals(rows: pd.DataFrame, name: str) -> dict[str, list[np.ndarray]]:
    """Per-sample figures of baselines by their names, an array for each draw."""
    column, samples = "mae_db" if name == "error_db" else name, dict[str, list[np.ndarray]]()
    for base in _rivals(rows):
        values = base["run"].samples.get(f"baseline/{base['method']}/{column}", np.zeros(0))
        if np.isfinite(values).any():
            samples.setdefault(base["method"], []).append(values[np.isfinite(values)])
    return samples


def _rivals(rows: pd.DataFrame) -> list[Row]:
    """Baselines of each draw that no run is of."""
    others = distinct_baselines(rows)
    return others[~others.method.isin(own_rows(rows).method)].to_dict("records")  # type: ignore[return-value]


def _styled(rows: pd.DataFrame) -> list[tuple[str, list[Row], dict[str, Any]]]:
    """Settings, their rows, colour and line: a method's own where each has one setting,
    else one by one.
    """
    groups = groups_of(own_rows(rows))
    names = [str(group.method.iloc[0]) for group in groups.values()]
    unique = len(set(names)) == len(names)
    styles = [style_of(name).line if unique else numbered_style(i) for i, name in enumerate(names)]
    styled = zip(groups.items(), styles, strict=True)
    return [(setting, group.to_dict("records"), style) for (setting, group), style in styled]  # type: ignore[misc]


def shorten_setting(text: str, most: int = 32) -> str:
    """Return overrides by the last part of their names, then cut to `most` characters."""
    words = [word.partition("=") for word in text.split()]
    text = " ".join(
        (key.rpartition(".")[2] if equals else key) + equals + value for key, equals, value in words
    )
    return text if len(text) <= most else text[: most - 1] + "…"


def draw_front(points: pd.DataFrame, others: pd.DataFrame, method: str, title: str) -> Figure:
    """Draw the points of a method beside others, see `measure_points`."""
    best, beaten = points[points.front == 1], points[points.front == 0]
    figure, ((axes,),) = panels(7.5, 4.2)
    axes.scatter(beaten.render_ms_p50, beaten.value, s=9, c="0.75", label="beaten")
    reach = [np.zeros(len(best)), best.render_ms_p95 - best.render_ms_p50]
    axes.errorbar(
        best.render_ms_p50,
        best.value,
        xerr=reach,
        label="not beaten",
        fmt="o-",
        color=style_of(method).colour,
        capsize=2,
        lw=1,
        ms=4,
    )
    beside = zip(others.label, others.render_ms_p50, others.value, strict=True)
    set_latency_axes(axes, best.figure.iloc[0], best.value, beside)
    axes.legend(loc="lower right", fontsize=8)
    axes.set_title(title, fontsize=10)
    return figure


# Fits that only keep rows take microseconds: decades of a logarithmic axis for them alone.
LEAST_S = 1e-3  # faster fits are drawn here
PANEL = 2.4  # inches


def draw_accuracy_over_cost(
    rows: pd.DataFrame, path: Path, ours: str, also: Sequence[str] = ()
) -> None:
    """Save accuracy against costs, see `save`: a line joins the efforts; `ours` has a large mark.

    `rows` are as of `average_cells`.
    """
    groups = [group for _, group in rows.groupby("dataset", sort=False)]
    columns = max(group.split.nunique() for group in groups) + bool(rows.query_ms.any())
    figure, grid = panels(
        max(PANEL * columns, 6.0),
        0.9 * PANEL * len(groups) + 0.9,
        len(groups),
        columns,
        sharey="row",
    )
    for line, dataset_rows in zip(grid, groups, strict=True):
        splits = [
            (cells, "train_cpu_s", split)
            for split, cells in dataset_rows.groupby("split", sort=False)
        ]
        first = splits[0][0]
        wanted = [
            *splits,
            *([(first, "query_ms", "queries")] if first.query_ms.notna().any() else []),
        ]
        for axis, (cells, horizontal, shows) in zip(line, wanted, strict=False):
            _panel(axis, cells, horizontal, ours)
            label = "training, CPU [s]" if horizontal == "train_cpu_s" else "one query [ms]"
            axis.set(title=f"{dataset_rows.dataset.iloc[0]}, {shows}", xlabel=label)
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
    for name, cells in rows.dropna(subset=horizontal).groupby("method", sort=False):
        cells = cells.sort_values("effort", na_position="first")
        style = style_of(str(name)).marked | {"markersize": 11 if name == ours else 6, "capsize": 2}
        x, spread = cells[horizontal].clip(lower=LEAST_S), cells.spread_db.fillna(0.0)
        level = [shown(*score) for score in zip(cells.figure, cells.score_db, strict=True)]
        axis.errorbar(x, level, spread, label=name, **style)
    set_log_axis(axis, 1.5)


LINE = 0.34  # height of a method [inch]


def draw_splits(rows: pd.DataFrame, path: Path, also: Sequence[str] = ()) -> None:
    """Save a panel per split: mean and standard error over draws,
    of `average_cells` of one dataset.
    """
    splits, names = list(rows.split.unique()), list(methods_by_mean_behind(rows))
    figure, grid = panels(
        2.2 + 3.1 * len(splits), 1.3 + LINE * len(names), 1, len(splits), sharey=True
    )
    for axis, split in zip(grid[0], splits, strict=True):
        # The largest effort
        cells = rows[rows.split == split].drop_duplicates("method", keep="last")
        cells = cells.fillna({"value_error": 0.0}).set_index("method")
        most = (cells.value + cells.value_error).max()
        best = cells.score_db.idxmax()
        for number, name in enumerate(names):
            if name not in cells.index:
                axis.text(0.02 * most, number, "not possible", va="center", fontsize=8, color="0.5")
                continue
            row = cells.loc[name]
            axis.barh(
                number,
                row.value,
                xerr=row.value_error,
                color=style_of(name).colour,
                alpha=1.0 if name == best else 0.45,
                capsize=2.5,
            )
            axis.text(
                min(row.value + row.value_error + 0.02 * most, 1.02 * most),
                number,
                f"{row.value:.3g}, fit {_seconds(row.train_s)}",
                va="center",
                fontsize=7.5,
            )
        draws = int(cells.seeds.max())
        axis.set(
            title=f"{split}, {draws} draw{'s' if draws > 1 else ''}",
            xlabel=axis_of(cells.figure.iloc[0]),
            xlim=(0, 1.5 * most),
        )
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

"""Plots of runs, each an SVG text; a figure's label is its title, which the page sets as text."""

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

from gsparc.evaluation.drawing import numbered_style, panels, save, set_latency_axes, set_log_axis, style_of
from gsparc.evaluation.metric_formats import OF_KIND, heading_of, score_of
from gsparc.evaluation.report.tables import groups_of, interval_of_figure
from gsparc.evaluation.results import Run, distinct_baselines, own_rows
from gsparc.evaluation.table import Row
from gsparc.prediction.pareto import pareto_front

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
    """Test accuracy against latency: runs with intervals, baselines, swept fronts, and the Pareto front."""
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
                [p50], [estimate.value], xerr=[[0.0], [max((p95 or p50) - p50, 0.0)]], yerr=estimate.bars,
                fmt="o", ms=4, lw=0.7, color=style["color"], label=None if number else setting,
            )  # fmt: skip
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
    """Draw the shares of test samples that are at most so good, per setting over its seeds, a panel a figure.

    With the band that the whole curve lies in at 95 % (Dvoretzky, Kiefer and Wolfowitz 1956; Massart): seeds
    share their test samples, whose number counts once. `TIMES` among `names` are single queries.
    """
    figure, ((*line,),) = panels(max(4.2 * len(names), WIDE), TALL, 1, len(names))
    for axes, name in zip(line, names, strict=True):
        for setting, group, style in _styled(rows):
            every = [_values_of(row["run"], name) for row in group]
            every = [values[np.isfinite(values)] for values in every]
            count = max(map(len, every)) if name != TIMES else sum(map(len, every))
            values, share = _shares(every)
            # DKW: P(sup |F_n - F| > e) <= 2 exp(-2 n e^2), Massart 1990 for the constant 2.
            half = np.sqrt(np.log(2 / (1 - BAND)) / (2 * max(count, 1)))
            axes.step(values, share, where="post", lw=1.2, label=labels.get(setting, setting), **style)
            low, high = np.clip(share - half, 0, 1), np.clip(share + half, 0, 1)
            axes.fill_between(values, low, high, step="post", color=style["color"], alpha=0.08, lw=0)
        beside = [base["run"].samples for base in _rivals(rows) if base["method"] == "gp"]
        if known := [own[f"baseline/gp/{name}"] for own in beside if f"baseline/gp/{name}" in own]:
            axes.step(*_shares(known), lw=0.8, label="gp", **style_of("gp").line)  # of all draws
        axes.set_xlabel("one query, alone [ms]" if name == TIMES else f"{heading_of(name)} of a test sample")
        if name in (TIMES, "mse", "error_power"):
            set_log_axis(axes, np.inf if name == TIMES else 0.0)
    line[0].set_ylabel("share of samples")
    handles, shown = line[0].get_legend_handles_labels()
    figure.legend(handles, [shorten_setting(one, 90) for one in shown], loc="outside lower center", ncols=2)
    figure.set_label("How the accuracy is distributed (95 % bands)")
    return figure


def draw_sweep(rows: pd.DataFrame, title: str, path: Path) -> None:
    """Save the figure that ends a sweep: distributions over test samples and of single queries, as PNG.

    The paper's ablations draw the same: SSIM, PSNR, squared error, render time.
    """
    own = own_rows(rows)
    names = [name for name in OF_KIND[own.kind.iloc[0]].distributions if name in own.run.iloc[0].samples]
    names += [TIMES] if any(len(run.render_ms) for run in own.run) else []
    if not names:  # nothing was tested
        return
    labels = {}
    for setting, group in groups_of(own).items():
        seconds, ms = group.train_s.mean(), group.query_ms.dropna().mean()
        labels[setting] = f"{shorten_setting(setting, 40)}: training {seconds:.3g} s, one query {ms:.3g} ms"
    figure = draw_distributions(rows, names, labels)
    figure.suptitle(title, fontsize=9)
    save(figure, path, 100)


def _shares(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All values (n,) sorted, and the share of them that each is at least as large as."""
    values = np.sort(np.concatenate(parts))
    return values, np.arange(1, len(values) + 1) / len(values)


def _values_of(run: Run, name: str) -> np.ndarray:
    """A per-sample figure (n,) of a run, empty where it has none; an error by its size."""
    values = run.render_ms if name == TIMES else run.samples.get(name, np.zeros(0))
    return np.abs(values) if name == "error_db" else values


def _rivals(rows: pd.DataFrame) -> list[Row]:
    """Baselines of each draw that no run is of."""
    others = distinct_baselines(rows)
    return others[~others.method.isin(own_rows(rows).method)].to_dict("records")  # type: ignore[return-value]


def _styled(rows: pd.DataFrame) -> list[tuple[str, list[Row], dict[str, Any]]]:
    """Settings, their rows, colour and line: a method's own where each has one setting, else one by one."""
    groups = groups_of(own_rows(rows))
    names = [str(group.method.iloc[0]) for group in groups.values()]
    unique = len(set(names)) == len(names)
    styles = [style_of(name).line if unique else numbered_style(i) for i, name in enumerate(names)]
    every = zip(groups.items(), styles, strict=True)
    return [(setting, group.to_dict("records"), style) for (setting, group), style in every]  # type: ignore[misc]


def shorten_setting(text: str, most: int = 32) -> str:
    """Return overrides by the last part of their names, then cut to `most` characters."""
    words = [word.partition("=") for word in text.split()]
    text = " ".join(
        (key.rpartition(".")[2] if equals else key) + equals + value for key, equals, value in words
    )
    return text if len(text) <= most else text[: most - 1] + "…"

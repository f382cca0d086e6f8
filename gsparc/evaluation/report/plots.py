"""Plots of runs, each an SVG text."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from scipy.stats import spearmanr

from gsparc.data.schema import Kind
from gsparc.evaluation.metrics import lower_is_better, score_of
from gsparc.evaluation.report.intervals import interval, over_seeds
from gsparc.evaluation.report.learning import curve, validation_figure
from gsparc.evaluation.report.runs import PER_SAMPLE, Run
from gsparc.evaluation.report.tables import BASELINES, HEADS, grouped
from gsparc.methods.pareto import front

WIDE, TALL = 7.0, 3.8
BAND = 0.95
CDFS: dict[Kind, tuple[str, ...]] = {
    "spectrum": ("ssim_gauss", "psnr_db", "mse"), "csi": ("snr_db", "error_power"), "rssi": ("error_db",)
}  # fmt: skip


def svg(figure: Figure) -> str:
    """The figure as an SVG element, without the XML head; text stays text."""
    out = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "gsparc"}):
        FigureCanvasSVG(figure).print_svg(out, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    return text[text.index("<svg") :]


def pareto(runs: Sequence[Run], fronts: Sequence[dict[str, np.ndarray]] = ()) -> Figure:
    """Test accuracy against latency: runs with intervals, baselines, swept fronts, and the Pareto front."""
    name = runs[0].figure
    figure, axes = _figure()
    x: list[float] = []
    y: list[float] = []
    for number, (setting, group) in enumerate(grouped(runs).items()):
        for run in group:
            p50, p95 = run.latency
            found = interval(run, name)
            if p50 is None or found is None:
                continue
            low, high = (found.low or found.value), (found.high or found.value)
            axes.errorbar(
                [p50], [found.value], xerr=[[0.0], [max((p95 or p50) - p50, 0.0)]],
                yerr=[[max(found.value - low, 0.0)], [max(high - found.value, 0.0)]],
                fmt="o", ms=4, lw=0.7, color=f"C{number % 10}",
                label=setting if run is group[0] else None,
            )  # fmt: skip
            x.append(p50)
            y.append(found.value)
    for base in BASELINES:
        value = runs[0].facts.get(f"baseline/{base}/{name}")
        ms = runs[0].facts.get(f"baseline/{base}/render_ms_p50")
        if value is not None and ms is not None:
            axes.scatter([ms], [value], marker="s", s=16, c="0.5")
            axes.annotate(
                base, (ms, value), xytext=(4, -3), textcoords="offset points", fontsize=7, color="0.4"
            )
            x.append(float(ms))
            y.append(float(value))
    for columns in fronts:
        if name in columns:
            on = columns["front"] == 1
            axes.plot(
                columns["render_ms_p50"][on], columns[name][on], ".-", lw=0.8, c="k", label="swept front"
            )
    best = front(x, [score_of(name, v) for v in y])
    axes.step([x[i] for i in best], [y[i] for i in best], where="post", lw=0.6, c="0.7", label="Pareto front")
    axes.set_xscale("log")
    _accuracy_axis(axes, name)
    _clip_outliers(axes, name, y)
    axes.set_xlabel("one query [ms], median; whisker to the 95th percentile")
    axes.set_title("Accuracy against latency (95 % intervals)", fontsize=9)
    _legend(axes)
    return figure


def accuracy_cdf(runs: Sequence[Run]) -> Figure:
    """Share of test samples that are at most so good, per setting, with 95 % bands."""
    name = PER_SAMPLE[runs[0].kind]
    figure, axes = _figure()
    for number, (setting, group) in enumerate(grouped(runs).items()):
        values = [run.samples[name] for run in group if name in run.samples]
        if values:
            pooled = np.concatenate(values)
            pooled = np.abs(pooled) if name == "error_db" else pooled
            _cdf(axes, pooled[np.isfinite(pooled)], setting, number, samples=len(values[0]))
    rival = runs[0].samples.get(f"baseline/gp/{name}")
    if rival is not None:
        axes.step(np.sort(rival), np.arange(1, len(rival) + 1) / len(rival), c="k", lw=0.8, label="gp")
    axes.set_xlabel(f"{HEADS.get(name, name)} of a test sample")
    axes.set_ylabel("share of samples")
    axes.set_title("How the accuracy is distributed (95 % bands)", fontsize=9)
    _legend(axes)
    return figure


def distributions(runs: Sequence[Run], title: str, path: Path) -> None:
    """The figure that ends a sweep: distributions over test samples and of single queries, as a PNG file.

    The paper's ablations draw the same: SSIM, PSNR, squared error, render time.
    """
    kind = runs[0].kind
    names = [name for name in CDFS[kind] if name in runs[0].samples]
    timed = any(len(run.render_ms) for run in runs)
    figure = Figure(figsize=(4.2 * (len(names) + timed), 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(names) + timed, squeeze=False)[0]
    for number, (setting, group) in enumerate(grouped(runs).items()):
        seconds = np.mean([float(run.facts["time/train_s"]) for run in group])
        ms = [p50 for p50, _ in (run.latency for run in group) if p50 is not None]
        label = f"{_short(setting, 40)}: {seconds:.3g} s, {np.mean(ms):.3g} ms"
        for axes, name in zip(panels, names, strict=False):
            values = np.abs(np.concatenate([run.samples[name] for run in group]))
            _cdf(axes, values[np.isfinite(values)], label, number, samples=len(group[0].samples[name]))
            axes.set_xlabel(HEADS.get(name, name))
        if timed:
            every = [run.render_ms for run in group if len(run.render_ms)]
            _cdf(panels[-1], np.concatenate(every), label, number)
            panels[-1].set_xlabel("one query, alone [ms]")
            panels[-1].set_xscale("log")
            panels[-1].xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            panels[-1].xaxis.set_major_formatter("{x:g}")
            panels[-1].xaxis.set_minor_formatter(NullFormatter())
    for axes, name in zip(panels, names, strict=False):
        if name in ("mse", "error_power"):
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())  # within a decade its labels would overlap
    for axes in panels:
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("share")
    figure.suptitle(title, fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", fontsize=7, ncols=2, title="training, one query"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def latency_cdf(runs: Sequence[Run]) -> Figure | None:
    """Share of single queries that take at most so long; None where none were timed one by one."""
    timed = {k: g for k, g in grouped(runs).items() if any(len(run.render_ms) for run in g)}
    if not timed:
        return None
    figure, axes = _figure()
    for number, (setting, group) in enumerate(timed.items()):
        _cdf(axes, np.concatenate([run.render_ms for run in group]), setting, number)
    axes.set_xscale("log")
    axes.set_xlabel("one query, end to end [ms]")
    axes.set_ylabel("share of queries")
    axes.set_title("Render times, measured after the sweep, alone and in turns (95 % bands)", fontsize=9)
    _legend(axes)
    return figure


def _cdf(axes: Axes, values: np.ndarray, label: str, number: int, samples: int | None = None) -> None:
    """With the band that the whole curve lies in at 95 % (Dvoretzky, Kiefer and Wolfowitz 1956; Massart)."""
    share = np.arange(1, len(values) + 1) / len(values)
    half = np.sqrt(np.log(2 / (1 - BAND)) / (2 * (samples or len(values))))
    color = f"C{number % 10}"
    axes.step(np.sort(values), share, where="post", color=color, lw=1.2, label=label)
    low, high = np.clip(share - half, 0, 1), np.clip(share + half, 0, 1)
    axes.fill_between(np.sort(values), low, high, step="post", color=color, alpha=0.08, lw=0)


def learning(runs: Sequence[Run]) -> Figure:
    """Validation accuracy against seconds of learning; settings of several seeds as a band."""
    name = validation_figure(runs[0])
    figure, axes = _figure()
    for number, (setting, group) in enumerate(grouped(runs).items()):
        color, first = f"C{number % 10}", True
        for run in group:
            seconds, values = curve(run)
            style = "o-" if len(seconds) > 1 else "D"
            axes.plot(seconds, values, style, ms=3, lw=1, color=color, label=setting if first else None)
            first = False
        same = {len(curve(run)[0]) for run in group}
        if len(group) > 1 and len(same) == 1:
            every = np.stack([curve(run)[1] for run in group])
            when = np.stack([curve(run)[0] for run in group]).mean(0)
            axes.fill_between(when, every.min(0), every.max(0), color=color, alpha=0.15, lw=0)
    axes.set_xscale("log")
    _accuracy_axis(axes, name)
    axes.set_xlabel("seconds of learning (diamond: trained in one piece, test rows)")
    axes.set_title("Validation accuracy against training time (band: seeds)", fontsize=9)
    _legend(axes)
    return figure


def costs(runs: Sequence[Run]) -> Figure:
    """Points measured, seconds simulated, seconds trained, milliseconds a query, and the accuracy."""
    groups = grouped(runs)
    figure = Figure(figsize=(WIDE + 2, 1.2 + 0.35 * len(groups)), layout="constrained")
    panels = figure.subplots(1, 5, sharey=True)
    name = runs[0].figure
    columns = [
        ("points measured", lambda run: float(run.measured)),
        ("s simulated", lambda run: run.facts.get("dataset/simulate_s")),
        ("s trained", lambda run: run.facts.get("time/train_s")),
        ("ms a query", lambda run: run.latency[0]),
        (HEADS.get(name, name), lambda run: run.figure_of(name)),
    ]
    for panel, (title, value) in zip(panels, columns, strict=True):
        for row, group in enumerate(groups.values()):
            known = [float(v) for v in map(value, group) if v is not None]
            if not known:
                panel.text(0, row, " none", va="center", fontsize=7, color="0.5")
                continue
            found = over_seeds(known)
            low, high = found.low or found.value, found.high or found.value
            panel.barh(row, found.value, color=f"C{row % 10}", alpha=0.8)
            panel.errorbar(
                [found.value], [row], xerr=[[found.value - low], [high - found.value]], c="k", lw=0.8
            )
            panel.text(found.value, row, f" {found.value:.3g}", va="center", fontsize=7)
        panel.set_title(title, fontsize=8)
        panel.tick_params(labelsize=7)
        panel.margins(x=0.3)
    panels[0].set_yticks(range(len(groups)), [_short(setting) for setting in groups])
    panels[0].invert_yaxis()
    figure.suptitle("Total costs (lines: spread over seeds)", fontsize=9)
    return figure


def measurements(runs: Sequence[Run]) -> Figure | None:
    """Accuracy against the number of measurements for every method; None when all runs had equally many."""
    if len({run.measured for run in runs}) < 2:
        return None
    name = runs[0].figure
    figure, axes = _figure()
    series: dict[str, dict[int, list[float]]] = {}
    for run in runs:
        found = {str(run.facts.get("model/name")): run.figure_of(name)}
        found |= {base: run.facts.get(f"baseline/{base}/{name}") for base in BASELINES}
        for method, value in found.items():
            if value is not None:
                series.setdefault(method, {}).setdefault(run.measured, []).append(float(value))
    for number, (method, by_count) in enumerate(series.items()):
        counts = sorted(by_count)
        mean = [float(np.mean(by_count[n])) for n in counts]
        axes.plot(counts, mean, "o-", ms=3, lw=1, color=f"C{number % 10}", label=method)
        low, high = [min(by_count[n]) for n in counts], [max(by_count[n]) for n in counts]
        axes.fill_between(counts, low, high, color=f"C{number % 10}", alpha=0.15, lw=0)
    axes.set_xscale("log")
    _accuracy_axis(axes, name)
    axes.set_xlabel("measurements learned from")
    axes.set_title("Accuracy against the number of measurements (band: seeds)", fontsize=9)
    _legend(axes)
    return figure


def confidence(runs: Sequence[Run]) -> Figure | None:
    """Error against confidence, and the error of the most confident share of answers; None without any."""
    name = PER_SAMPLE[runs[0].kind]
    sure = [r for r in runs if name in r.samples and np.isfinite(r.samples.get("confidence", [np.nan])).any()]
    if not sure:
        return None
    figure = Figure(figsize=(WIDE, TALL), layout="constrained")
    points, kept = figure.subplots(1, 2)
    for number, run in enumerate(sure[:8]):
        value = np.abs(run.samples[name]) if name == "error_db" else run.samples[name]
        known = np.isfinite(value) & np.isfinite(run.samples["confidence"])
        stated, value = run.samples["confidence"][known], value[known]
        if len(stated) < 3 or np.ptp(stated) == 0:
            continue
        rank = spearmanr(stated, value)
        order = np.argsort(-stated, kind="stable")
        share = np.arange(1, len(order) + 1) / len(order)
        mean = np.cumsum(value[order]) / np.arange(1, len(order) + 1)
        error = value.std(ddof=1) / np.sqrt(np.arange(1, len(order) + 1))
        color = f"C{number % 10}"
        points.scatter(
            stated, value, s=8, color=color, label=f"{_short(run.setting)}: rank {rank.statistic:+.2f}"
        )
        kept.plot(share, mean, color=color, lw=1)
        kept.fill_between(share, mean - 1.96 * error, mean + 1.96 * error, color=color, alpha=0.1, lw=0)
    points.set_xlabel("confidence")
    points.set_ylabel(HEADS.get(name, name))
    kept.set_xlabel("share of answers used, most confident first")
    kept.set_title("mean over the answers used (95 % band)", fontsize=8)
    for axes in (points, kept):
        axes.grid(alpha=0.3)
    _legend(points)
    return figure


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDE, TALL), layout="constrained")
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    return figure, axes


def _accuracy_axis(axes: Axes, name: str) -> None:
    axes.set_ylabel(HEADS.get(name, name))
    if lower_is_better(name):
        axes.set_yscale("log")


def _clip_outliers(axes: Axes, name: str, values: Sequence[float]) -> None:
    """A black image at 6 dB would flatten everything above 25: values far below the median are not drawn."""
    if name == "psnr_db" and len(values) > 1:
        middle, best = float(np.median(values)), max(values)
        axes.set_ylim(bottom=max(axes.get_ylim()[0], middle - max(3 * (best - middle), 5.0)))


def _legend(axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(handles, [_short(label, 44) for label in labels], fontsize=6.5)


def _short(text: str, most: int = 32) -> str:
    """Overrides by the last part of their names, then cut to `most` characters."""
    words = [word.partition("=") for word in text.split()]
    text = " ".join(
        (key.rpartition(".")[2] if equals else key) + equals + value for key, equals, value in words
    )
    return text if len(text) <= most else text[: most - 1] + "…"

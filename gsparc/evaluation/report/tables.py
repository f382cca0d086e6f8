"""Tables of runs; no accuracy without its time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from gsparc.evaluation.metric_formats import PER_SAMPLE, TABLES, form_of, heading_of, score_of
from gsparc.evaluation.report.runs import Run, number, sizes
from gsparc.evaluation.report.table import Column, Interval, Table, interval, over_seeds

BASELINES = ("zero", "mean", "nearest", "idw", "gp")
WORST = 3


def heading(name: str, note: str = "") -> Column:
    """Of an accuracy."""
    return Column(heading_of(name), form_of(name), note)


def grouped(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs that differ by their seed only, by setting, in order of appearance."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.setting, []).append(run)
    return groups


def results(runs: Sequence[Run]) -> Table:
    """Every run and every baseline of one study: accuracy, time, memory, size, effects, data and commit."""
    figures = TABLES[runs[0].kind]
    table = Table(
        "Results",
        [
            Column("method and setting"), Column("seed", "d"),
            *(heading(f, "95 % interval: bootstrap over test samples") for f in figures),
            Column("train s", ".3g"), Column("query ms p50", ".3g"), Column("p95", ".3g"),
            Column("batch of 64, ms each", ".3g"), Column("memory MB", ".0f"), Column("Gaussians", "d"),
            Column("effects"), Column("load", ".2f", "1-minute load per core while measured"),
            Column("data"), Column("commit"),
        ],
        note="Brackets: 95 % intervals over test samples (independent samples assumed). Baselines are timed "
        "in turns within a run, the models of a sweep alone after it.",
    )  # fmt: skip
    for run in runs:
        p50, p95 = run.latency
        get = run.facts.get
        table.add(
            run.setting, get("seed"), *(interval(run, f) for f in figures), get("time/train_s"), p50, p95,
            get("time/render_ms_batch64"), get("memory/peak_mb"), get("model/num_gaussians"),
            get("model/effects") or "none", get("machine/load"), str(get("dataset/sha256"))[:8],
            str(get("git"))[:8],
        )  # fmt: skip
    first = runs[0].facts
    for name in BASELINES:
        if f"baseline/{name}/{figures[0]}" not in first:
            continue
        base = {key.rsplit("/", 1)[1]: v for key, v in first.items() if key.startswith(f"baseline/{name}/")}
        table.add(
            name, None, *(base.get(f) for f in figures), base.get("train_s"), base.get("render_ms_p50"),
            base.get("render_ms_p95"), base.get("render_ms_batch64"), None, None, "none",
            first.get("machine/load"), str(first.get("dataset/sha256"))[:8], str(first.get("git"))[:8],
        )  # fmt: skip
    return table


def seeds(runs: Sequence[Run]) -> Table:
    """Settings side by side, their spread over seeds, and what they cost."""
    figures = TABLES[runs[0].kind]
    table = Table(
        "Settings over seeds",
        [
            Column("method and setting"), Column("seeds", "d"), *(heading(f) for f in figures),
            Column("train s", ".3g"), Column("query ms p50", ".3g"), Column("p95", ".3g"),
            Column("Gaussians", ".0f"),
        ],
        note="Brackets: least and largest over seeds.",
    )  # fmt: skip
    for setting, group in grouped(runs).items():
        p50, p95 = zip(*(run.latency for run in group), strict=True)
        spread = [over_seeds([run.figure_of(f) for run in group]) for f in figures]
        times = over_seeds([number(run.facts.get("time/train_s")) for run in group])
        size = over_seeds([number(run.facts.get("model/num_gaussians")) for run in group])
        table.add(setting, len(group), *spread, times, over_seeds(p50), over_seeds(p95), size)
    return table


def costs(runs: Sequence[Run]) -> Table:
    """Total costs: measurements, simulation, training and query time."""
    figure = runs[0].figure
    table = Table(
        "Total costs",
        [
            Column("method and setting"), Column("seed", "d"), Column("points measured", "d"),
            Column("seconds simulated", ".3g"), Column("seconds trained", ".3g"), Column("ms a query", ".3g"),
            heading(figure),
        ],
        note="Seconds simulated: of the ray tracer that made the data; none where they were measured.",
    )  # fmt: skip
    for run in runs:
        table.add(
            run.setting, run.facts.get("seed"), run.measured, run.facts.get("dataset/simulate_s"),
            run.facts.get("time/train_s"), run.latency[0], interval(run, figure),
        )  # fmt: skip
    return table


def worst(runs: Sequence[Run]) -> Table:
    """The three test positions with the largest error of each run."""
    name = PER_SAMPLE[runs[0].kind]
    table = Table(
        "The three worst receivers",
        [
            Column("method and setting"), Column("seed", "d"), Column("sample"), Column("where [m]"),
            Column(heading_of(name), ".2f"), Column("gp there", ".2f"), Column("confidence", ".2f"),
        ],
        note="The moving end's position; the Gaussian process there shows whether it is hard for all.",
    )  # fmt: skip
    for run in runs:
        own = run.samples
        if name not in own:
            continue
        error = np.abs(own[name]) if name == "error_db" else -own[name]
        for i in np.argsort(-np.nan_to_num(error, nan=-np.inf))[:WORST]:
            place = ", ".join(f"{own[axis][i]:.2f}" for axis in ("x_m", "y_m", "z_m"))
            rival = own.get(f"baseline/gp/{name}")
            table.add(
                run.setting, run.facts.get("seed"), str(own["name"][i]), place, float(own[name][i]),
                None if rival is None else float(rival[i]), float(own["confidence"][i]),
            )  # fmt: skip
    return table


MINUTES = (1, 2, 5, 10)


def within_minutes(runs: Sequence[Run]) -> Table:
    """The best validation figure reached within fixed training times, and the time to fixed figures."""
    figure = validation_figure(runs[0])
    head = heading_of(figure)
    table = Table(
        "Accuracy against training time",
        [
            Column("method and setting"), Column("seed", "d"),
            *(Column(f"{head} within {m} min", form_of(figure)) for m in MINUTES),
            *(Column(f"s to {level:.4g}", ".3g") for level in levels(runs)),
            Column("train s in all", ".3g"),
        ],
        note="Validation rows; seconds of learning with preparation, without validation. Methods that train "
        "in one piece have no curve: their test figure counts from the end of their training.",
    )  # fmt: skip
    for run in runs:
        seconds, values = curve(run)
        if not len(seconds):
            continue
        best = np.array([score_of(figure, v) for v in values])
        early = [seconds <= 60 * minutes for minutes in MINUTES]
        cells = [float(values[t][best[t].argmax()]) if t.any() else None for t in early]
        good = [best >= score_of(figure, level) for level in levels(runs)]
        reached = [float(seconds[t.argmax()]) if t.any() else None for t in good]
        table.add(run.setting, run.facts.get("seed"), *cells, *reached, run.facts.get("time/train_s"))
    return table


def validation_figure(run: Run) -> str:
    """The figure of a learning curve: validation of channels and powers logs the mean squared error."""
    return "psnr_db" if run.kind == "spectrum" else "mse"


def curve(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (n,) and validation figures (n,); one point for a method that trains in one piece."""
    figure = validation_figure(run)
    found = run.curve.get(f"val/{figure}")
    if found is not None and np.isfinite(found).any():
        known = np.isfinite(found)
        return run.curve["train_s"][known], found[known]
    end, value = number(run.facts.get("time/train_s")), run.figure_of(figure)
    if end is None or value is None:
        return np.zeros(0), np.zeros(0)
    return np.array([end]), np.array([value])


def levels(runs: Sequence[Run], count: int = 3) -> list[float]:
    """Round figures between what the worst and the best run reach, the worst first."""
    score = partial(score_of, validation_figure(runs[0]))
    ends = [max(curve(run)[1], key=score) for run in runs if len(curve(run)[0])]
    if not ends:
        return []
    worst, best = min(ends, key=score), max(ends, key=score)
    if abs(best - worst) < 1e-9 * max(abs(best), 1e-9):
        return [float(f"{worst:.3g}")]
    between = {float(f"{v:.3g}") for v in np.linspace(worst, best, count + 2)[:-1]}
    return sorted(between, key=score)[:count]


def effects(runs: Sequence[Run]) -> Table | None:
    """Gain and cost of each effect: paired differences between runs of one split; None without pairs."""
    name = PER_SAMPLE[runs[0].kind]
    table = Table(
        "Effects: gain and cost",
        [
            Column("effect"), Column("without"), Column("with"),
            Column(f"{heading_of(name)} gained", "+.2f"),
            Column("train s more", "+.3g"), Column("query ms more", "+.3g"),
        ],
        note="Differences per test sample, mean and 95 % interval; same seed, same split.",
    )  # fmt: skip
    for off, on in product(runs, runs):
        if _differ_by_effect(off, on):
            costs = [(number(run.facts.get("time/train_s")), run.latency[0]) for run in (off, on)]
            spent = [None if a is None or b is None else b - a for a, b in zip(*costs, strict=True)]
            table.add(on.facts.get("model/effects"), off.setting, on.setting, _paired(off, on, name), *spent)
    return table if table.rows else None


def _differ_by_effect(off: Run, on: Run) -> bool:
    names = ("dataset/sha256", "split/sha256", "seed", "model/name")
    same = all(off.facts.get(name) == on.facts.get(name) for name in names)
    plain = (off.facts.get("model/effects") or "none") == "none"
    return same and plain and (on.facts.get("model/effects") or "none") != "none"


def _paired(off: Run, on: Run, name: str) -> Interval | None:
    """Mean difference per sample in dB, larger is better."""
    if name not in off.samples or name not in on.samples or len(off.samples[name]) != len(on.samples[name]):
        return None
    gap = (-1 if name == "error_db" else 1) * (sizes(on, name) - sizes(off, name))
    gap = gap[np.isfinite(gap)]
    half = 1.96 * float(gap.std(ddof=1)) / math.sqrt(len(gap)) if len(gap) > 1 else math.nan
    return Interval(float(gap.mean()), float(gap.mean()) - half, float(gap.mean()) + half)

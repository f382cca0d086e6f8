"""`gsparc study kind=positions`: what errors of positions and of directions of arrival cost each method."""

from __future__ import annotations

import csv
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.table import Table

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.console import open_console
from gsparc.evaluation.evaluate import dataset_facts
from gsparc.evaluation.metrics import DECIDING
from gsparc.evaluation.scores import score
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.methods.method import FitContext, Method
from gsparc.methods.timing import machine_facts
from gsparc.studies import cli
from gsparc.studies.study.variants import setting

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """One point of the sweep.

    Attributes:
        method: name of the variant or rival.
        where: what was disturbed: nothing (`none`), positions of a `query` or of training (`train`), or the
            `directions` of arrival that training receivers measured.
        error: standard deviation of each coordinate [m], or of a direction about each of two axes [degrees].
        figure: name of the accuracy.
        value: its value on the test rows.
        train_s: seconds of the training it rests on [s].
    """

    method: str
    where: str
    error: float
    figure: str
    value: float
    train_s: float


def displaced(data: Measurements, rows: np.ndarray, error_m: float, seed: int) -> Measurements:
    """The moving end of `rows` believed elsewhere by N(0, error_m^2) per coordinate; all else the same."""
    offset = np.random.default_rng(seed).normal(scale=error_m, size=(len(rows), 3))
    name = "tx" if data.site.moving_end == "tx" else "rx_position"
    moved = getattr(data, name).copy()
    moved[rows] += offset
    return replace(data, **{name: moved})


def turned(
    data: Measurements, error_deg: float, seed: int, *, missing: float = 0.0, false: float = 0.0
) -> Measurements:
    """Directions of arrival as a receiver measures them; all else the same.

    Args:
        data: with directions.
        error_deg: standard deviation about each of two axes across a direction [degrees].
        seed: of the draw.
        missing: share of the directions that are not there.
        false: number of directions from anywhere, as a share of those that are there.

    Raises:
        ValueError: no directions.
    """
    if data.directions is None:
        raise ValueError(f"{data.site.name}: no directions of arrival to disturb; take errors_deg=[]")
    rng, sigma = np.random.default_rng(seed), np.radians(error_deg)
    measured = []
    for true in data.directions:
        ray = true.astype(np.float64)
        aside = rng.normal(scale=sigma, size=ray.shape)
        ray = ray + aside - (aside * ray).sum(1, keepdims=True) * ray
        ray = ray[rng.random(len(ray)) >= missing]
        ray = np.concatenate([ray, rng.normal(size=(rng.binomial(len(ray), false), 3))])
        measured.append((ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32))
    return replace(data, directions=measured)


def sweep(
    contenders: Mapping[str, Callable[[], Method]],
    data: Measurements,
    fold: Fold,
    errors_m: list[float],
    context: FitContext,
    *,
    train_errors: bool,
    seed: int,
    errors_deg: list[float] | None = None,
) -> Iterator[Row]:
    """Rows as they are finished; every method sees the same disturbed positions."""
    figure = DECIDING[data.site.kind]
    learned = np.concatenate([fold.train, fold.val])
    for name, make in contenders.items():
        method, seconds = _fitted(make, data, fold, context, name)
        yield Row(name, "none", 0.0, figure, _value(method, data, fold, figure), seconds)
        for error in errors_m:
            there = displaced(data, fold.test, error, seed)
            yield Row(name, "query", error, figure, _value(method, there, fold, figure), seconds)
        for error in errors_m if train_errors else ():
            there = displaced(data, learned, error, seed)
            method, seconds = _fitted(make, there, fold, context, f"{name}-{error:g}")
            yield Row(name, "train", error, figure, _value(method, data, fold, figure), seconds)
        for error in errors_deg or ():
            method, seconds = _fitted(make, turned(data, error, seed), fold, context, f"{name}-{error:g}deg")
            yield Row(name, "directions", error, figure, _value(method, data, fold, figure), seconds)


def _fitted(
    make: Callable[[], Method], data: Measurements, fold: Fold, context: FitContext, name: str
) -> tuple[Method, float]:
    method = make()
    return method, method.fit(data, fold, replace(context, run_dir=context.run_dir / name)).seconds


def _value(method: Method, data: Measurements, fold: Fold, figure: str) -> float:
    value = score((method,), data, Split("sensitivity", (fold,), ""), "test").figures()[figure]
    if value is None:
        raise ValueError(f"{figure} is not defined on these test rows")
    return value


PANELS = {
    "query": ("position error in queries [cm]", 100.0),
    "train": ("position error in training [cm]", 100.0),
    "directions": ("error of directions of arrival [degrees]", 1.0),
}


def draw(rows: list[Row], path: Path) -> None:
    """Accuracy against error, one panel for each kind."""
    there = [where for where in PANELS if any(row.where == where for row in rows)] or ["query"]
    figure = Figure(figsize=(5 * len(there), 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(there), sharey=True, squeeze=False)[0]
    for axis, where in zip(axes, there, strict=True):
        label, scale = PANELS[where]
        for method in dict.fromkeys(row.method for row in rows):
            points = [(r.error * scale, r.value) for r in rows if r.method == method and r.where == where]
            clean = [r.value for r in rows if r.method == method and r.where == "none"]
            if points:
                (line,) = axis.plot(*zip(*points, strict=True), marker="o", label=method)
                axis.axhline(clean[0], color=line.get_color(), linestyle=":", linewidth=1)
        axis.set_xscale("log")
        axis.set_xlabel(label)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(rows[0].figure)
    axes[0].legend(title="dotted: no error")
    figure.savefig(path, dpi=110)


def task(config: DictConfig) -> list[Row]:
    """Sweep, table, CSV and picture."""
    where = setting(config)
    run_dir, data = where.run_dir, where.data
    rows: list[Row] = []
    started = time.monotonic()
    found = sweep(
        where.makers, data, where.fold, [float(e) for e in config.errors_m], where.context,
        train_errors=bool(config.train_errors), seed=int(config.seed),
        errors_deg=[float(e) for e in config.errors_deg],
    )  # fmt: skip
    for row in found:
        rows.append(row)
        log.info("%s after %.0f s", row, time.monotonic() - started)
    with (run_dir / "sensitivity.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(Row)])
        writer.writerows(astuple(row) for row in rows)
    draw(rows, run_dir / "sensitivity.png")
    figure = rows[0].figure
    facts: dict[str, object] = {**dataset_facts(data), **machine_facts(), **provenance()}
    facts["seed"] = int(config.seed)
    for row in rows:
        facts[f"sensitivity/{row.method}/{row.where}/{row.error:g}/{figure}"] = row.value
        facts[f"sensitivity/{row.method}/{row.where}/{row.error:g}/train_s"] = row.train_s
    write_summary(run_dir / "summary.json", facts)
    table = Table(title=f"{data.site.name}: {rows[0].figure} against errors")
    for column in ("method", "disturbed", "error m, deg", rows[0].figure, "train s"):
        table.add_column(column, justify="left" if column in ("method", "disturbed") else "right")
    for row in rows:
        table.add_row(row.method, row.where, f"{row.error:g}", f"{row.value:.4g}", f"{row.train_s:.3g}")
    console = open_console()
    console.print(table)
    console.print(f"written to {run_dir}", highlight=False)
    return rows


def main() -> None:
    """Entry point."""
    cli.run(task, "sensitivity")


if __name__ == "__main__":
    main()

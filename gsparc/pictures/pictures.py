"""Pictures of a run: measured beside predicted targets, levels of sectors beside patterns,
confidences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill, wrap
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from gsparc.base.errors import list_first
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.data.walls import SceneWalls
from gsparc.evaluation.examples import Examples
from gsparc.evaluation.metrics import SpectrumMetrics
from gsparc.evaluation.summary import results_table
from gsparc.models.method import Method
from gsparc.models.powers.together.field import JointPowerField
from gsparc.models.powers.together.terms import rows_of_stations
from gsparc.pictures.drawing import PALETTE, colour_bar, panels, save
from gsparc.pictures.found_plan import draw_site_objects
from gsparc.prediction.confidence import Guarantee
from gsparc.prediction.left_out import Evidence, predict_rows
from gsparc.prediction.risk import Trial, bounded_loss
from gsparc.processes.sectors import NO_AZIMUTH
from gsparc.processes.uncertainty import risk_coverage
from gsparc.runs.evaluate import TrainedRun
from gsparc.training import tracking


def draw_and_log_run(
    run: TrainedRun,
    walls: SceneWalls | None,
    facts: Mapping[str, Any],
    eval_on: str,
    run_dir: Path,
    loggers: Sequence[Any],
) -> None:
    """Draw what the first fold's method predicts and found; give loggers the pictures,
    figures and the table of a run.
    """
    # Under other names, as `time/train_s` would cut off its curve; of the baselines a table.
    numbers = {name: value for name, value in facts.items() if isinstance(value, (int, float))}
    finals = {f"final/{name}": v for name, v in numbers.items() if not name.startswith("baseline/")}
    tracking.log_final(loggers, finals)
    method, data, fold = run.methods[0], run.data, run.split.folds[0]
    draw_sector_levels(method, data, fold, run_dir / "sectors.png")
    if len(fold.test):
        title = f"{data.site.name}: test rows of {method.label}"
        draw_predictions(
            method, data, fold.test, run.evaluation.examples, title, run_dir / "test.png"
        )
        tracking.log_picture(loggers, "test rows", run_dir / "test.png")
    table = results_table(facts, str(facts["model/label"]), prefix=eval_on)
    tracking.log_table(loggers, "results", *table.texts())
    sources = method.objects()
    if len(sources):
        draw_site_objects(data, sources, run_dir / "found.png", walls)
        tracking.log_picture(loggers, "found", run_dir / "found.png")


def draw_predictions(
    method: Method,
    data: Measurements,
    rows: np.ndarray,
    examples: Examples | None,
    title: str,
    path: Path,
) -> None:
    """Draw test rows (n,) as a fitted method predicts them: `examples` where there are some,
    else points.
    """
    if examples is not None:
        return save(draw_spectra(examples, title), path, 100)
    predicted, true = predict_rows(method, data, rows).mean.numpy(), data.targets(rows).numpy()
    scale = data.site.target_scale
    unit = data.site.level_unit if data.site.target.is_level else "dB"
    measured = data.censored_side(rows) == 0  # of a silent row the target is its level
    link = np.column_stack([data.moving[rows], data.stations_of(rows)])[measured]
    fix = np.unique(link, axis=0, return_inverse=True)[1].reshape(-1)
    draw_points(true[measured] * scale, predicted[measured] * scale, title, path, unit, fix)


def draw_points(
    target: np.ndarray,
    predicted: np.ndarray,
    title: str,
    path: Path,
    unit: str = "dB",
    fix: np.ndarray | None = None,
) -> None:
    """Save predicted against measured strength as PNG,
    and the error of the phase where there is one.

    `target` and `predicted`: (B, ...) complex channels or real powers, in physical units;
    `unit` of levels; `fix` (B,) int64: rows of one place, and of one station, have one prediction.
    """
    channels = np.iscomplexobj(target)
    figure, (axes,) = panels(8 if channels else 4.6, 4.2, 1, 2 if channels else 1)
    # The least float32 above 0: a power of 0 has no decibels, and would end the axis at -inf.
    tiny, factor = np.finfo(np.float32).tiny, 20 if channels else 10
    true_db, guess_db = (
        factor * np.log10(np.maximum(np.abs(x).ravel(), tiny)) for x in (target, predicted)
    )
    # The faintest half percent are outliers of the logarithm; the strongest are what matters.
    low, high = np.percentile(true_db, [0.5, 100])
    quantity = "channel gain" if channels else "received power"
    axes[0].plot([low, high], [low, high], color="grey", linewidth=1)
    _draw_dense(axes[0], true_db, guess_db)
    count = np.zeros(0) if fix is None or channels else np.bincount(fix)
    if many := (count >= MANY).nonzero()[0].tolist():
        for number in many:
            among = fix == number
            ends = true_db[among].min(), true_db[among].max()
            axes[0].plot(ends, guess_db[among][:2], color=PALETTE[1], linewidth=0.8, alpha=0.7)
        label = f"{len(many)} places with {MANY} rows or more, {int(count[many].sum())} rows"
        axes[0].plot([], [], color=PALETTE[1], label=label)
        axes[0].legend(loc="upper left", fontsize=7)
    # Errors of what lies below the axis would be those of nothing heard.
    heard = np.isfinite(guess_db) & (true_db > low)
    error = np.median(np.abs(guess_db - true_db)[heard]) if heard.any() else np.nan
    axes[0].set(
        title=f"{quantity}, median error {error:.1f} dB",
        xlabel=f"measured {quantity} [{unit}]",
        ylabel=f"predicted [{unit}]",
        xlim=(low - 3, high + 3),
        ylim=(low - 3, high + 3),
        aspect="equal",
    )
    if channels:
        turn = np.degrees(np.angle(predicted.ravel() * target.ravel().conj()))
        _draw_dense(axes[1], true_db, turn)
        axes[1].set(
            title=f"phase, median error {np.median(np.abs(turn)):.1f} degrees",
            xlabel="measured channel gain [dB]",
            ylabel="phase error [degrees]",
            xlim=(low - 3, high + 3),
            ylim=(-180, 180),
            yticks=range(-180, 181, 90),
        )
    figure.suptitle(title)
    save(figure, path)


def _draw_dense(axis: Any, x: np.ndarray, y: np.ndarray) -> None:
    """Points (n,), the darker the more of them lie together; the fewest are drawn last."""
    x, y = np.stack([x, y])[:, np.isfinite(x + y)]
    counts, *edges = np.histogram2d(x, y, bins=CELLS)
    cell = (
        np.searchsorted(e, v, "right").clip(1, CELLS) - 1
        for e, v in zip(edges, (x, y), strict=True)
    )
    dense = np.log(counts[tuple(cell)])
    order = np.argsort(-dense)
    axis.scatter(x[order], y[order], s=6, c=dense[order], cmap="viridis_r", linewidths=0)


def draw_spectra(examples: Examples, title: str) -> Figure:
    """Return a line per row: measured, predicted by each method on one scale,
    and what the last one misses.

    Under each prediction stand its PSNR and SSIM, and the confidence of the last one.
    """
    predicted, edges = examples.predicted, examples.edges
    count, across = len(examples.rows), len(predicted) + 2
    figure, axes = panels(
        max(1.75 * across, 8.5),
        1.55 * count + 1.2,
        count,
        across,
        sharex=True,
        sharey=True,
        grid=False,
    )
    options: dict[str, Any] = {"origin": "lower", "aspect": "auto", "extent": edges}
    metric = SpectrumMetrics()
    for values in predicted.values():
        metric.update(torch.from_numpy(values), torch.from_numpy(examples.truth))
    figures = {
        name: values.reshape(len(predicted), count) for name, values in metric.compute().items()
    }
    for number, (line, true, row) in enumerate(
        zip(axes, examples.truth, examples.rows, strict=True)
    ):
        for axis, image in zip(
            line, (true, *(values[number] for values in predicted.values())), strict=False
        ):
            power = axis.imshow(image, vmin=0, vmax=1, cmap="inferno", **options)
        for place, axis in enumerate(line[1:-1]):
            psnr, ssim = (figures[name][place, number] for name in ("psnr_db", "ssim_gauss"))
            similarity = f", SSIM {ssim:.3f}" if np.isfinite(ssim) else ""
            axis.set_xlabel(f"{psnr:.1f} dB{similarity}", fontsize=8)
        # Half of full scale, saturating: at +-1 usual errors of a few hundredths would be white.
        error = line[-1].imshow(image - true, vmin=-0.5, vmax=0.5, cmap="RdBu_r", **options)
        if np.isfinite(examples.confidence[number]):
            line[-1].set_xlabel(f"confidence {examples.confidence[number]:.2f}", fontsize=8)
        line[0].set_yticks(np.arange(30 * np.ceil(edges[2] / 30), edges[3] + 1, 30))
        line[0].set_ylabel(f"row {row}", fontsize=9)
    for axis, name in zip(
        axes[0], ("measured", *predicted, f"{[*predicted][-1]} - measured"), strict=True
    ):
        axis.set_title("\n".join(wrap(name, 22)), fontsize=9)
    for axis in axes[-1]:
        axis.set_xticks(np.arange(90 * np.ceil(edges[0] / 90), edges[1] + 1, 90))
        axis.tick_params(labelsize=7)
    figure.supylabel("elevation [°]", fontsize=9)
    label = "relative strength; azimuth [°] runs across"
    colour_bar(power, axes[:, :-1], label, location="bottom", aspect=40)
    colour_bar(error, axes[:, -1], "difference", location="bottom", aspect=10)
    figure.suptitle(title)
    figure.set_label("The same test rows, measured and predicted")
    return figure


MANY = 5  # rows of one place and station, which are named
CELLS = 40  # along each side of a scatter, in which points are counted
NAMES = {"expected": "expected error", "learned": "learned"}


def draw_calibration(
    evidence: Evidence, trials: Sequence[Trial], guarantee: Guarantee, title: str, path: Path
) -> None:
    """Save risk against coverage, and what came of the draws, as one PNG."""
    figure, ((coverage_axis, trials_axis),) = panels(11, 4.2, 1, 2)
    loss = bounded_loss(evidence.error)
    coverage = np.arange(1, len(loss) + 1) / len(loss)
    for kind, score in evidence.scores.items():
        risk = risk_coverage(score, loss)
        coverage_axis.plot(coverage, risk, label=f"{NAMES[kind]}, area {risk.mean():.3g}")
    # Ordered by the errors themselves: no score can be below this curve.
    risk = risk_coverage(-loss, loss)
    coverage_axis.plot(coverage, risk, "k:", label=f"knowing the errors, area {risk.mean():.3g}")
    coverage_axis.set(
        title=title,
        xlabel="share of positions accepted",
        ylabel="mean error among them (|e|²/|h|², at most 1)",
    )
    for trial, colour in zip(trials, PALETTE, strict=False):
        broken = trial.summarise()["broken_of_all"]
        label = f"{trial.how}: broken in {broken:.0%} of {len(trial.realised)} draws"
        trials_axis.scatter(
            trial.coverage, trial.realised, s=9, alpha=0.4, color=colour, label=label
        )
    # a draw that accepts nobody has no share of bad ones: NaN
    worst = max(guarantee.alpha, *(np.nan_to_num(trial.realised).max() for trial in trials))
    trials_axis.set(xlim=(-0.02, 1.02), ylim=(-0.02 * worst, 1.1 * worst))
    if not any(trial.coverage.any() for trial in trials):
        trials_axis.text(0.5, 0.5 * worst, "no draw accepted anybody", ha="center")
    trials_axis.axhline(guarantee.alpha, color="black", linewidth=1)
    trials_axis.set(
        title=f"promise: at most {guarantee.alpha:.0%} bad, "
        f"broken in at most {guarantee.delta:.0%}",
        xlabel="share of test positions accepted",
        ylabel="realised share of bad ones among them",
    )
    for axis in (coverage_axis, trials_axis):
        axis.legend(fontsize=8)
    save(figure, path)


# Sectors drawn, contradicted azimuths and then most rows first; beside each other
MOST, ACROSS = 12, 4
LEAST = 10  # rows that were heard of a sector, whose azimuth is not contradicted


def draw_sector_levels(method: Method, data: Measurements, fold: Fold, path: Path) -> None:
    """Draw rows of sectors that were learned from, less the law of distance,
    where there are patterns.
    """
    field = method.joint_method()
    if not isinstance(field, JointPowerField) or field.network is None:
        return
    trend = field.network
    heard = rows_of_stations(data, fold.learned(), field.places).measured_rows
    count = np.bincount(heard.station, minlength=len(field.places))
    azimuth, stations = trend.table[:, 0].numpy(), data.site.every_station
    # Without an azimuth there is no angle to draw over.
    count[azimuth == NO_AZIMUTH] = 0
    nominal = stations.beams[:, 0] % 360
    turned = ~np.isclose(azimuth, nominal)  # as levels contradict what was given
    enough = count >= np.where(turned, 1, LEAST)
    chosen = [int(t) for t in np.lexsort((-count, ~turned)) if enough[t]][:MOST]
    if not chosen:
        return
    down = -(-len(chosen) // ACROSS)
    figure, axes = panels(9, 2.0 * down + 0.8, down, ACROSS, sharex=True, sharey=True)
    for axis, t in zip(axes.flat, chosen, strict=False):
        at = torch.from_numpy(np.c_[heard.select_station(t).places, np.full(count[t], t)])
        angle, distance = _about(at, azimuth[t])
        rest = (
            torch.from_numpy(heard.select_station(t).decibels)
            - trend.mean(at)
            - trend.pattern_loss(at)
        )
        axis.plot(angle, rest, ".", color=PALETTE[0], markersize=3, alpha=0.5)
        turn = np.linspace(-180, 180, 181)
        # Bearings from north, clockwise: east = sin, north = cos.
        bearing = np.radians(turn + azimuth[t])
        ring = np.median(distance) * np.c_[np.sin(bearing), np.cos(bearing)]
        height = np.full((len(ring), 1), float(at[:, 2].median()))
        around = np.c_[
            ring + field.places[t, :2], height, np.tile(np.r_[field.places[t], t], (len(ring), 1))
        ]
        # A median: rows behind buildings are far below the pattern, and would lower a mean.
        gain = float((rest + trend.pattern_loss(at)).median())
        axis.plot(turn, gain - trend.pattern_loss(torch.from_numpy(around)), color=PALETTE[1])
        given = f" (given {nominal[t]:.0f})" if turned[t] else ""
        title = f"{stations.shown[t]}, {azimuth[t]:.0f} deg{given}"
        axis.set(title=title, xlim=(-180, 180), xticks=range(-180, 181, 90))
    few = [stations.shown[t] for t in np.flatnonzero((azimuth != NO_AZIMUTH) & ~enough)]
    note = f"; too few rows to draw: {list_first(few, 6)}" if few else ""
    figure.suptitle(
        fill(f"{len(chosen)} of {len(count)} sectors, contradicted azimuths first{note}", 90)
    )
    for axis in axes.flat[len(chosen) :]:
        axis.set_visible(False)
    figure.supxlabel("angle from the azimuth that is used [deg]")
    figure.supylabel("level less the law of distance [dB]")
    save(figure, path)


def _about(places: torch.Tensor, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n,) from an azimuth [deg] and flat distances (n,) [m] of places (n, 7)."""
    east, north = (places[:, :2] - places[:, 3:5]).numpy().T
    # Into [-180, 180): the back of the antenna stands at both ends.
    angle = (np.degrees(np.arctan2(east, north)) - azimuth + 180) % 360 - 180
    return angle, np.hypot(east, north)

"""What a confidence is worth, drawn from per-sample figures: over losses, what it accepts,
by brackets.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gsparc.evaluation.metric_formats import OF_KIND, axis_of, lower_is_better
from gsparc.evaluation.results import own_rows
from gsparc.evaluation.table import Row
from gsparc.field.losses import weigh_losses
from gsparc.pictures.drawing import GREY, PALETTE, numbered_style, panels, save, style_of
from gsparc.prediction.risk import bounded_loss
from gsparc.processes.uncertainty import rank_correlation

PAPER_TAU = 0.59  # of confidences between their least and largest over the test rows
BRACKET_DB = 5.0
OUTER = 0.02, 0.98  # quantiles of the rows: brackets beyond them are those of these
WIDE, TALL = 3.6, 3.2  # inches of a panel


def draw_confidences(
    names: Iterable[str], rows: pd.DataFrame, title: str, folder: Path, end: str = ""
) -> None:
    """Save pictures of `PICTURES` by name, of the runs of a frame that state a confidence,
    if any.
    """
    records: list[Row] = own_rows(rows).to_dict("records")  # type: ignore[assignment]
    confidences = (row["run"].samples.get("confidence", np.array([np.nan])) for row in records)
    runs = [row for row, sure in zip(records, confidences, strict=True) if np.isfinite(sure).all()]
    for name in names if runs else ():
        # Powers have no ratio to an error.
        if name != "snr_brackets" or not lower_is_better(OF_KIND[runs[0]["kind"]].of_sample):
            figure = PICTURES[name](runs)
            figure.suptitle(title, fontsize=9)
            save(figure, folder / f"{name}{end}.png")


def _label(row: Row) -> str:
    return f"{row['setting']}, seed {row['seed']}"


def _loss(row: Row) -> np.ndarray:
    """What a test row costs (n,): the paper's of spectra, |e|^2 / |h|^2 of channels,
    |decibels| of powers; of others the mean absolute error.
    """
    samples = row["run"].samples
    if "error_db" in samples:
        return np.abs(samples["error_db"])
    if "error_power" in samples:
        return bounded_loss(samples["error_power"] / np.maximum(samples["target_power"], 1e-300))
    if "ssim_gauss" not in samples:
        return samples["mae"]
    # Images smaller than the window have no SSIM: the absolute error alone tells.
    return weigh_losses(samples["mae"], np.nan_to_num(samples["ssim_gauss"], nan=1.0))


def _draw_over_loss(runs: list[Row]) -> Figure:
    """Confidence of low and high losses, over quintiles of loss, and against the absolute error."""
    figure, grid = panels(3 * WIDE, TALL * len(runs) + 0.3, len(runs), 3)
    for (both, fifths, scatter), row in zip(grid, runs, strict=True):
        loss = _loss(row)
        finite = np.isfinite(loss)  # rows where nothing was heard have no error
        sure, loss = row["run"].samples["confidence"][finite], loss[finite]
        high = loss > np.median(loss)
        bins = np.linspace(sure.min(), sure.max(), 25)
        for name, part, colour in (("low", ~high, PALETTE[2]), ("high", high, PALETTE[1])):
            both.hist(sure[part], bins, density=True, alpha=0.6, color=colour, label=f"{name} loss")
        both.set(
            xlabel="confidence C",
            ylabel="density of test rows",
            title=f"{_label(row)}, {len(loss)} rows",
        )
        both.legend()
        part = np.searchsorted(np.quantile(loss, (0.2, 0.4, 0.6, 0.8)), loss)
        names = ["lowest", "2", "3", "4", "highest"]
        fifths.boxplot([sure[part == number] for number in range(5)], tick_labels=names)
        fifths.set(xlabel="fifth of the loss", ylabel="confidence C")
        spectra = "ssim_gauss" in row["run"].samples
        error = row["run"].samples["mae"][finite] if spectra else loss
        scatter.plot(error, sure, ".", markersize=4, alpha=0.5, color=PALETTE[0])
        alike = rank_correlation(sure, error)
        scatter.set(
            title=f"rank correlation {np.nan if alike is None else alike:.2f}",
            xlabel="MAE of a test row" if spectra else "loss of a test row",
            ylabel="confidence C",
        )
    return figure


def _draw_accepted(runs: list[Row]) -> Figure:
    """Which test rows the paper's threshold accepts, and the share accepted over all thresholds."""
    figure, ((places, curve),) = panels(2.4 * WIDE, TALL + 0.6, 1, 2)
    taus = np.linspace(0, 1, 201)
    for number, row in enumerate(runs):
        samples = row["run"].samples
        sure, style = samples["confidence"], numbered_style(number)
        # The paper's normalisation is relative to the rows that are tested:
        # nowhere else is it used.
        relative = (sure - sure.min()) / max(np.ptp(sure), 1e-30)
        for values, line, end in (
            (sure, "-", ""),
            (relative, "--", " (paper: min-max over the test rows)"),
        ):
            share = (values[:, None] >= taus).mean(0)
            curve.plot(taus, share, **{**style, "linestyle": line}, label=_label(row) + end)
        if number == 0:
            above = relative >= PAPER_TAU
            for part, colour, side in ((above, PALETTE[2], "above"), (~above, GREY, "below")):
                label = f"{side} {PAPER_TAU} (paper), {part.mean():.0%}"
                places.plot(
                    samples["x_m"][part],
                    samples["y_m"][part],
                    ".",
                    color=colour,
                    markersize=4,
                    label=label,
                )
    places.set(
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        title="test rows, confidence by min-max over them",
    )
    places.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18))
    curve.axvline(PAPER_TAU, color=GREY, linestyle=":", label=f"threshold {PAPER_TAU}")
    curve.set(
        xlabel="threshold τ", ylabel="share of test rows with C ≥ τ", xlim=(0, 1), ylim=(0, 1.02)
    )
    curve.legend()
    return figure


def _draw_brackets(runs: list[Row]) -> Figure:
    """Boxes of rows' ratios to their error, methods beside each other,
    and the confidence by bracket.
    """
    figure, grid = panels(2.2 * WIDE, TALL * len(runs) + 0.3, len(runs), 2)
    for (errors_axis, scores_axis), row in zip(grid, runs, strict=True):
        data, name = row["run"].samples, OF_KIND[row["kind"]].of_sample
        stem, end = "baseline/", f"/{name}"
        beside = {
            k[len(stem) : -len(end)]: data[k]
            for k in data
            if k.startswith(stem) and k.endswith(end)
        }
        samples = {k: v[np.isfinite(v)] for k, v in {**beside, _label(row): data[name]}.items()}
        boxes = errors_axis.boxplot(
            list(samples.values()), tick_labels=list(samples), showfliers=False, patch_artist=True
        )
        for box, method in zip(boxes["boxes"], [*beside, row["method"]], strict=True):
            box.set(facecolor=style_of(method).colour, alpha=0.5)
        errors_axis.tick_params(axis="x", labelrotation=30)
        errors_axis.set(ylabel=f"{axis_of(name)} of a test row")
        mask = np.isfinite(data[name])
        low, high = np.quantile(data[name][mask], OUTER)
        # Outermost are open
        begin = BRACKET_DB * np.floor(np.clip(data[name][mask], low, high) / BRACKET_DB)
        starts, counts = np.unique(begin, return_counts=True)
        sure = [data["confidence"][mask][begin == start].mean() for start in starts]
        names = [f"{a:.0f}–{a + BRACKET_DB:.0f}" for a in starts]
        names[0], names[-1] = f"< {starts[0] + BRACKET_DB:.0f}", f"≥ {starts[-1]:.0f}"
        names = [f"{name}\n{count}" for name, count in zip(names, counts, strict=True)]
        scores_axis.tick_params(axis="x", labelsize=7)
        scores_axis.bar(names, sure, color=PALETTE[0], alpha=0.7)
        scores_axis.axhline(PAPER_TAU, color=GREY, linestyle="--", label=f"threshold {PAPER_TAU}")
        scores_axis.set(
            xlabel=f"{axis_of(name)}, and the number of rows",
            ylabel="mean confidence",
            ylim=(0, 1.15),
        )
        scores_axis.legend(loc="upper left")
    return figure


PICTURES = {
    "confidence": _draw_over_loss,
    "accepted": _draw_accepted,
    "snr_brackets": _draw_brackets,
}

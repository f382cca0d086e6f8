"""Figures of merit by kind of target: what computes them, how they are shown and compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from gsparc.data.schema import Scored
from gsparc.evaluation.metrics import (
    AlignedChannelMetrics,
    ChannelMetrics,
    PowerMetrics,
    SampleMetric,
    SpectrumMetrics,
)


@dataclass(frozen=True)
class Figure:
    """How a figure of merit is shown and compared.

    Attributes:
        heading: of its column and axis.
        form: format of its numbers.
        better: which values are better; a `ratio` of powers is compared in decibels, smaller is
            better.
        of_sample: the column of `per_sample.csv` that it is made of; empty: its own name.
        root: whether it is the root of the mean square of that column, not its mean.
    """

    heading: str
    form: str = ".4f"
    better: Literal["larger", "smaller", "ratio"] = "larger"
    of_sample: str = ""
    root: bool = False


# SSIM in two windows: Gaussian 11, Wang et al. 2004, and uniform 7, scikit-image's default; the
# first also of images continued by zeros, as in the paper's tables.
FIGURES = {
    "psnr_db": Figure("PSNR dB", ".2f"),
    "ssim_gauss": Figure("SSIM (Gauss 11)"),
    "ssim": Figure("SSIM (uniform 7)"),
    "ssim_padded": Figure("SSIM (Gauss 11, zero padded)"),
    "mse": Figure("MSE", ".3g", "ratio"),
    "mae": Figure("MAE", ".3g", "smaller"),
    "nmse": Figure("NMSE", ".3g", "ratio", "error_power"),
    "nmse_aligned": Figure("NMSE, rows aligned", ".3g", "ratio", "error_power"),
    "tone_rmse_db": Figure("RMSE of tones dB", ".2f", "smaller"),
    "nmse_scalar": Figure("NMSE up to a scalar", ".3g", "ratio"),
    "snr_db": Figure("SNR dB", ".2f"),
    "power_mae_db": Figure("MAE of power dB", ".2f", "smaller"),
    "rmse_db": Figure("RMSE dB", ".2f", "smaller", "error_db", root=True),
    "rmse_db_with_silent": Figure(
        "RMSE dB, silent too", ".2f", "smaller", "error_db_with_silent", root=True
    ),
    "mae_db": Figure("MAE dB", ".2f", "smaller"),
    "error_db": Figure("error dB", ".2f", "smaller"),
    "best_server": Figure("strongest told", ".1%"),
    "skill": Figure("skill", ".3f"),
    "psnr_db_median": Figure("median PSNR dB", ".2f"),
    "ssim_gauss_median": Figure("median SSIM"),
    "mse_median": Figure("median MSE", ".3g", "ratio"),
    "snr_db_p50": Figure("median SNR dB", ".2f"),
    "mae_db_median": Figure("median error dB", ".2f", "smaller"),
    "reduced_chi2": Figure("reduced chi-squared", ".2f", "smaller"),
    "interval/coverage_90": Figure("in 90 % interval", ".2f"),
    "outage/brier": Figure("outage, Brier score", ".4f", "smaller"),
    "rmse_db_after_constant": Figure("after a constant, dB", ".2f", "smaller"),
}
WITH_SILENT = "rmse_db_with_silent"
GIVEN_HEARD = "rmse_db judges levels of rows that are heard or listed, heard_db of gsparc predict"
LISTED = "ahead_listed"
BEST_SERVER = "best_server"  # beside errors of several stations, never compared by
# 1 where predicted variances are right: shown beside errors, never compared
CALIBRATION = "reduced_chi2"
OF_LISTS = WITH_SILENT, "rmse_db", BEST_SERVER, CALIBRATION  # that cells which are off change
WITHOUT_OFF = "_without_off"  # behind these figures: of all other cells


@dataclass(frozen=True)
class KindFigures:
    """Figures of what is measured: what computes them, and where they are shown.

    Attributes:
        metric: computes them.
        columns: of tables; methods, fronts and effects are compared by the first.
        second: beside the score in comparisons.
        of_sample: of a single sample, in decibels.
        distributions: over samples, drawn after a sweep.
        medians: shown beside the columns, which are means, where there is room.
        compared: further columns of comparisons.
    """

    metric: type[SampleMetric]
    columns: tuple[str, ...]
    second: str
    of_sample: str
    distributions: tuple[str, ...]
    medians: tuple[str, ...]
    compared: tuple[str, ...]


OF_KIND: dict[Scored, KindFigures] = {
    "spectrum": KindFigures(
        SpectrumMetrics,
        ("psnr_db", "ssim_gauss", "ssim", "mse"),
        "ssim",
        "psnr_db",
        ("ssim_gauss", "psnr_db", "mse"),
        ("psnr_db_median", "ssim_gauss_median", "mse_median"),
        compared=("psnr_db_median", "ssim_gauss_median"),
    ),
    "csi": KindFigures(
        ChannelMetrics,
        ("nmse", "nmse_scalar", "snr_db"),
        "snr_db",
        "snr_db",
        ("snr_db", "nmse"),
        ("snr_db_p50",),
        compared=("snr_db_p50",),
    ),
    "aligned csi": KindFigures(
        AlignedChannelMetrics,
        ("nmse_aligned", "tone_rmse_db", "snr_db"),
        "tone_rmse_db",
        "snr_db",
        ("snr_db", "nmse"),
        ("snr_db_p50",),
        compared=("snr_db_p50",),
    ),
    "rssi": KindFigures(
        PowerMetrics,
        ("rmse_db", "mae_db"),
        "mae_db",
        "error_db",
        ("error_db",),
        ("mae_db_median",),
        compared=("mae_db_median",),
    ),
}
DECIDING: dict[Scored, str] = {kind: figures.columns[0] for kind, figures in OF_KIND.items()}
# Columns that are no figures by themselves
PARTS = {figure.of_sample for figure in FIGURES.values()}


def scored_kind(facts: Mapping[str, Any]) -> Scored:
    """Return the kind of measurement that a summary is of; spectra where an old one does not say.

    Raises:
        ValueError: a kind that has no figures.
    """
    kind = facts.get("dataset/kind") or "spectrum"
    if kind not in OF_KIND:
        raise ValueError(f"a summary is of {kind!r}; figures are known of {', '.join(OF_KIND)}")
    return kind


def paired_values(samples: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return per-sample values whose means are the flat figures,
    so that their differences can be paired.

    `nmse` is each sample's share, |e|^2 / mean |h|^2: its mean is the global NMSE.

    >>> error, power = np.array([1.0, 3.0]), np.array([10.0, 30.0])
    >>> samples = {"error_power": error, "target_power": power, "mse": error}
    >>> float(paired_values(samples)["nmse"].mean())
    0.1
    """
    values = {
        name: column for name, column in samples.items() if name in FIGURES and name not in PARTS
    }
    if "error_db" in samples:
        values["mae_db"] = np.abs(samples["error_db"])
    error, power = samples.get("error_power", samples["mse"]), samples["target_power"]
    if np.nansum(power) > 0:
        values["nmse"] = error / np.nanmean(power)
    return values


def main_figure(facts: Mapping[str, Any], prefix: str = "test") -> str:
    """Return the figure that methods are compared by; where rows were silent, these count too."""
    return deciding_figure({WITH_SILENT: facts.get(f"{prefix}/{WITH_SILENT}")}, scored_kind(facts))


def judged_by(facts: Mapping[str, Any], prefix: str = "test") -> dict[str, str]:
    """Return figures that methods are judged by, by what leads in them are called.

    Beside silent rows also those of heard ones.

    >>> judged_by({"dataset/kind": "rssi", "test/rmse_db_with_silent": 4.0})
    {'ahead': 'rmse_db_with_silent', 'ahead_listed': 'rmse_db'}
    """
    figure = main_figure(facts, prefix)
    return {"ahead": figure} | ({LISTED: "rmse_db"} if figure == WITH_SILENT else {})


def deciding_figure(figures: Mapping[str, Any], kind: Scored) -> str:
    """Return what `main_figure` does, of figures by name."""
    return DECIDING[kind] if figures.get(WITH_SILENT) is None else WITH_SILENT


def heading_of(name: str) -> str:
    """Return the heading of a column; the name itself where it is not a figure of merit."""
    return _look_up(name).heading


def axis_of(name: str) -> str:
    """Return the label of an axis, with the unit in brackets."""
    return heading_of(name).replace(" dB", " [dB]")


def score_heading(name: str) -> str:
    """Return the heading of a figure that methods are placed by, ratios in decibels,
    with what is better.

    >>> score_heading("nmse"), score_heading("psnr_db")
    ('NMSE dB (less is better)', 'PSNR dB')
    """
    ratio = " dB" if is_power_ratio(name) else ""
    return f"{heading_of(name)}{ratio}{' (less is better)' if lower_is_better(name) else ''}"


def sample_column(name: str) -> str:
    """Return the column of `per_sample.csv` that a figure is made of."""
    return _look_up(name).of_sample or name


def is_root(name: str) -> bool:
    """Return whether a figure is the root of a mean square of `sample_column`."""
    return _look_up(name).root


def is_power_ratio(name: str) -> bool:
    """Return whether a figure is a ratio of powers, which spans decades."""
    return _look_up(name).better == "ratio"


def number_format(name: str) -> str:
    """Format of its numbers."""
    return _look_up(name).form


def lower_is_better(name: str) -> bool:
    """Return whether a smaller value of a figure of merit is the better one."""
    return _look_up(name).better != "larger"


def score_of(name: str, value: float) -> float:
    """Return a number that is larger when the figure is better: ratios in decibels,
    else as it is.
    """
    better = _look_up(name).better
    if better == "ratio":
        # 1e-12 stands for a ratio of 0: 120 dB, beyond what float32 targets can tell.
        return -10 * math.log10(max(value, 1e-12))
    return -value if better == "smaller" else value


def _look_up(name: str) -> Figure:
    # Also of settings and seconds: shown by their own name.
    return FIGURES.get(name, Figure(name))

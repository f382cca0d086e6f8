"""How honest predicted variances are: errors over deviations, intervals that hold the truth, outages."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import norm

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.data.units import power_in_decibels
from gsparc.evaluation.by_station import best_server, rmse_after_constants
from gsparc.evaluation.metric_formats import CALIBRATION, WITH_SILENT
from gsparc.evaluation.scores import Scores, errors_with_silent

SHARE = 0.9  # of the truth that an interval is to hold
SAME_LEVEL_DB = 4e-4  # levels that differ by less are one: above float32 rounding, below any two real ones


def power_intervals(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """Figures of predicted normal distributions of decibels; empty where the method has no variance.

    `reduced_chi2` is that of `reduced_chi_squared`, of heard rows in decibels;
    `interval/coverage_90` is the share of heard rows whose power lies in the central 90 % interval,
    `interval/width_db` its mean width. Where powers may be too weak to be heard, `outage/rate` is the share
    of rows that were, `outage/brier` the mean square of (predicted probability - what happened), 0 when
    perfect, and `outage/brier_rate` what always saying the rate gives.
    """
    mean, variance = scores.samples["prediction"], scores.variance * data.site.target_scale**2
    # Decibels of a power need a mean above 0.
    known = np.isfinite(variance) & (variance > 0) & (mean > 0)
    if not known.any():
        return {}
    mean_db, spread_db = power_in_decibels(mean[known], variance[known])
    row = scores.row[known]
    power = data.target[row, 0].astype(np.float64) * data.site.target_scale
    silent = data.censored_side(row) > 0
    heard = (data.censored_side(row) == 0) & (power > 0)
    figures: dict[str, float | None] = {}
    if heard.any():
        # z of .95 is 1.645 for the central 90 % of a normal distribution.
        half = norm.ppf((1 + SHARE) / 2) * spread_db[heard]
        error = np.abs(10 * np.log10(power[heard]) - mean_db[heard])
        figures |= {"interval/coverage_90": float((error <= half).mean())}
        figures |= {"interval/width_db": float(2 * half.mean())}
        figures |= {CALIBRATION: float(np.mean((error / spread_db[heard]) ** 2))}
    level_db = sensitivity_levels(data)
    if level_db is None:
        return figures
    of_row = level_db[0 if data.station is None else data.station[row]]
    limited = np.isfinite(of_row)
    if not limited.any():  # all of them are of stations that heard everything
        return figures
    chance = norm.cdf((of_row[limited] - mean_db[limited]) / spread_db[limited])
    rate = float(silent[limited].mean())
    return figures | {
        "outage/rate": rate,
        "outage/brier": float(np.mean((chance - silent[limited]) ** 2)),
        # Brier 1950; saying the rate r each time gives its variance, r (1 - r).
        "outage/brier_rate": rate * (1 - rate),
    }


def reduced_chi_squared(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """Return the mean squared error over its predicted variance; empty where the method has no variance.

    1 where `Predictor.std` is right on average, above where it is too small, below where it is too large.
    """
    variance = scores.variance * data.site.target_scale**2
    known = np.isfinite(scores.samples["mse"]) & (variance > 0)
    if not known.any():
        return {}
    return {CALIBRATION: float(np.mean(scores.samples["mse"][known] / variance[known]))}


def sensitivity_levels(data: Measurements) -> np.ndarray | None:
    """Level (T,) [dB] below which each station hears nothing; None where every one heard all.

    NaN where it heard all, or its silent rows have several levels, as in lists of the strongest.
    """
    rows = np.flatnonzero(data.censored_side(np.arange(len(data))) > 0)
    if not len(rows):
        return None
    station = np.zeros(len(data), np.int64) if data.station is None else data.station
    # The target of a silent row is its level, a power in stored units.
    levels = pd.Series(10 * np.log10(data.target[rows, 0].astype(float) * data.site.target_scale))
    each = levels.groupby(station[rows]).agg(["first", "min", "max"])
    one = each["first"].where(each["max"] - each["min"] <= SAME_LEVEL_DB)
    return one.reindex(range(1 if data.site.stations is None else len(data.site.stations))).to_numpy()


def rmse_with_silent(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """RMSE [dB] of all rows, silent ones by what predictions exceed their level, and their number, if any.

    That of heard rows alone favours methods that learn from these alone: lists hold what is strong.
    """
    error = errors_with_silent(scores.samples, scores.row, data).get("error_db_with_silent")
    if error is None:
        return {}
    silent = int((data.censored_side(scores.row) > 0).sum())
    return {WITH_SILENT: float(np.sqrt(np.nanmean(error**2))), "silent_samples": silent}


def pool_figures(scores: Scores, data: Measurements, split: Split) -> dict[str, float | None]:
    """Accuracies and `reduced_chi_squared`; of powers `rmse_with_silent`, `power_intervals`, `best_server`.

    Of stations held out also the errors left after a constant of each.
    """
    figures = scores.figures()
    if data.site.kind != "rssi":
        figures |= reduced_chi_squared(scores, data)
    else:
        figures |= rmse_with_silent(scores, data) | power_intervals(scores, data) | best_server(scores, data)
        if split.name == "stations" and data.station is not None:
            figures["rmse_db_after_constant"] = rmse_after_constants(scores, data.station)
    return figures

"""How honest predicted variances of powers are: intervals that hold the truth, outages that come true."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.data.units import in_decibels
from gsparc.evaluation.scores import Scores

SHARE = 0.9  # of the truth that an interval is to hold


def power_intervals(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """Figures of predicted normal distributions of decibels; empty where the method has no variance.

    `interval/coverage_90` is the share of heard rows whose power lies in the central 90 % interval,
    `interval/width_db` its mean width. Where powers may be too weak to be heard, `outage/rate` is the share
    of rows that were, `outage/brier` the mean square of (predicted probability - what happened), 0 when
    perfect, and `outage/brier_rate` what always saying the rate gives.
    """
    mean, variance = scores.samples["prediction"], scores.variance * data.site.target_scale**2
    known = np.isfinite(variance) & (variance > 0) & (mean > 0)
    if not known.any():
        return {}
    mean_db, spread_db = in_decibels(mean[known], variance[known])
    row = scores.row[known]
    power = data.target[row, 0].astype(np.float64) * data.site.target_scale
    silent = data.side(row) > 0
    heard = (data.side(row) == 0) & (power > 0)
    figures: dict[str, float | None] = {}
    if heard.any():
        half = norm.ppf((1 + SHARE) / 2) * spread_db[heard]
        inside = np.abs(10 * np.log10(power[heard]) - mean_db[heard]) <= half
        figures |= {"interval/coverage_90": float(inside.mean()), "interval/width_db": float(2 * half.mean())}
    level_db = levels(data)
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
        "outage/brier_rate": rate * (1 - rate),
    }


def levels(data: Measurements) -> np.ndarray | None:
    """Level (T,) [dB] below which each station hears nothing, NaN where it heard all; None without any."""
    rows = np.flatnonzero(data.side(np.arange(len(data))) > 0)
    if not len(rows):
        return None
    station = np.zeros(len(data), np.int64) if data.station is None else data.station
    level = np.full(1 if data.site.stations is None else len(data.site.stations), np.nan)
    level[station[rows]] = 10 * np.log10(data.target[rows, 0].astype(np.float64) * data.site.target_scale)
    return level


def pooled(scores: Scores, data: Measurements, split: Split) -> dict[str, float | None]:
    """Accuracies, and of powers `power_intervals` and, of stations held out, `rmse_db_after_constant`."""
    figures = scores.figures()
    if data.site.kind == "rssi":
        figures |= power_intervals(scores, data)
        if split.name == "stations" and data.station is not None:
            figures["rmse_db_after_constant"] = scores.after_constant(data.station)
    return figures

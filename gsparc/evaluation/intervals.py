"""How honest predicted variances are: errors over deviations, intervals that hold the truth,
outages.
"""

from __future__ import annotations

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.data.units import power_in_decibels
from gsparc.evaluation.by_station import rmse_after_constants, score_best_server
from gsparc.evaluation.metric_formats import CALIBRATION, WITH_SILENT
from gsparc.evaluation.scores import Scores
from gsparc.physics.decibels import to_decibels
from gsparc.processes.uncertainty import coverage_and_width, half_width

SHARE = 0.9  # of the truth that an interval is to hold


def score_power_intervals(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """Return figures of predicted normal distributions of decibels;
    empty where the method has no variance.

    `reduced_chi2` is that of `reduced_chi_squared`, of heard rows in decibels;
    `interval/coverage_90` is the share of heard rows whose power lies in the central 90 % interval,
    `interval/width_db` its mean width; beside silent rows that of levels given that they are heard,
    which exceed the others by `heard_above_db`; `levels_rmse_db` is the error of the others there.
    Where powers may be too weak to be heard or listed, `outage/rate` is the share of rows that
    were, `outage/brier` the mean square of (predicted probability - what happened), 0 when perfect,
    and `outage/brier_rate` what always saying the rate gives.
    """
    mean, variance = scores.samples["prediction"], scores.variance * data.site.target_scale**2
    # Decibels of a power need a mean above 0.
    valid = np.isfinite(variance) & (variance > 0) & (mean > 0)
    if not valid.any():
        return {}
    mean_db, spread_db = power_in_decibels(mean[valid], variance[valid])
    row = scores.row[valid]
    power = data.powers(row)[:, 0]
    silent = data.censored_side(row) > 0
    heard = (data.censored_side(row) == 0) & (power > 0)
    figures: dict[str, float | None] = {}
    if heard.any():
        moments = [
            scores.samples[n][valid] for n in ("heard_db", "heard_std_db") if n in scores.samples
        ]
        middle, spread = (part[heard] for part in moments or (mean_db, spread_db))
        error = to_decibels(power[heard]) - middle
        coverage, width = coverage_and_width(error, half_width(SHARE) * spread)
        figures |= {"interval/coverage_90": coverage, "interval/width_db": width}
        figures |= {CALIBRATION: float(np.mean((error / spread) ** 2))}
        if moments:
            plain = to_decibels(power[heard]) - mean_db[heard]
            figures["heard_above_db"] = float((middle - mean_db[heard]).mean())
            figures["levels_rmse_db"] = float(np.sqrt(np.mean(plain**2)))
    chance = scores.samples.get("heard_share", scores.variance * np.nan)[valid]
    limited = np.isfinite(chance)
    if not limited.any():  # all of them are of stations that heard everything
        return figures
    rate = float(silent[limited].mean())
    return figures | {
        "outage/rate": rate,
        "outage/brier": float(np.mean((1 - chance - silent)[limited] ** 2)),
        # Brier 1950; saying the rate r each time gives its variance, r (1 - r).
        "outage/brier_rate": rate * (1 - rate),
    }


def reduced_chi_squared(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """Return the mean squared error over its predicted variance;
    empty where the method has no variance.

    1 where `Predictor.std` is right on average, above where it is too small,
    below where it is too large.
    """
    variance = scores.variance * data.site.target_scale**2
    valid = np.isfinite(scores.samples["mse"]) & (variance > 0)
    if not valid.any():
        return {}
    return {CALIBRATION: float(np.mean(scores.samples["mse"][valid] / variance[valid]))}


def rmse_with_silent(scores: Scores, data: Measurements) -> dict[str, float | None]:
    """Return RMSE [dB] of all rows, silent ones by what predictions exceed their level, and their
    number, if any.

    That of heard rows alone says nothing of levels that are not heard.
    """
    error, silent = scores.samples.get("error_db_with_silent"), data.censored_side(scores.row) > 0
    if error is None:
        return {}
    return {WITH_SILENT: float(np.sqrt(np.nanmean(error**2))), "silent_samples": int(silent.sum())}


def pool_figures(scores: Scores, data: Measurements, split: Split) -> dict[str, float | None]:
    """Return accuracies and `reduced_chi_squared`; of powers `rmse_with_silent`,
    `score_power_intervals`, `score_best_server`.

    Of stations held out also the errors left after a constant of each.
    """
    figures = scores.figures()
    if not data.site.target.is_level:
        figures |= reduced_chi_squared(scores, data)
    else:
        figures |= (
            rmse_with_silent(scores, data)
            | score_power_intervals(scores, data)
            | score_best_server(scores, data)
        )
        if split.name == "stations":
            figures["rmse_db_after_constant"] = rmse_after_constants(scores, data.stations_of())
    return figures

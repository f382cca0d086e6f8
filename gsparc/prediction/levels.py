"""Received power in decibels, with its deviation, of whatever a model predicts or a row holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.target import Kind
from gsparc.data.units import power_in_decibels
from gsparc.models.method import Prediction
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.answers import ask
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import query_ends


def predicted_levels(
    prediction: Prediction, kind: Kind, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the level and its standard deviation (B,) float64 [dB];
    NaN where no power is predicted.

    The power of a channel is its mean over antennas and subcarriers, expected: |mean|^2 + error
    variance. Its deviation takes the error for one complex normal variable shared by all entries,
    which overstates it.

    Args:
        prediction: a prediction; its variance is of the entries.
        kind: `rssi` or `csi`.
        scale: of stored targets; 1 where `prediction` is in physical units.

    Returns:
        The deviation is 1 dB everywhere where the method has no variance.
    """
    mean = prediction.mean.detach().cpu().numpy().reshape(len(prediction.mean), -1)
    variance, error = prediction.variance, np.zeros(len(mean))
    if variance is not None:
        error = variance.detach().cpu().double().numpy() * scale**2
    if kind == "rssi":
        power = mean[:, 0].astype(np.float64) * scale
    else:
        mean_power = (np.abs(mean.astype(np.complex128)) ** 2).mean(axis=1) * scale**2
        # Var |m + e|^2 for complex normal e is 2 |m|^2 v + v^2.
        power, error = mean_power + error, 2 * mean_power * error + error**2
    level, spread = np.full(len(mean), np.nan), np.full(len(mean), np.nan)
    good = np.isfinite(power) & (power > 0)
    level[good], spread[good] = power_in_decibels(power[good], error[good])
    if variance is None:
        spread[good] = 1.0
    return level, np.where(spread > 0, spread, np.nan)


def predict_levels(
    predictor: Predictor,
    places: np.ndarray,
    other_end: Sequence[float] | None = None,
    station: np.ndarray | None = None,
    **how: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the level and its deviation (n,) [dB] at world places (n, 3).

    See `predicted_levels`, `query_ends`, and of `how` `ask`.
    """
    ends = query_ends(predictor.site, places, other_end, station)
    return predicted_levels(ask(predictor, ends, linear=True, **how), predictor.site.kind)


def measured_levels(data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level (n,) [dB] of rows (n,), NaN where nothing was measured,
    and which side they are censored on.
    """
    power, side = data.powers(rows), data.censored_side(rows)
    if data.mask is not None:
        # Censored rows are masked out as targets, but their levels are known.
        seen = data.mask[rows].reshape(power.shape) | (side != 0)[:, None]
        power = np.where(seen, power, np.nan)
    finite = np.isfinite(power)
    mean = np.where(finite, power, 0).sum(axis=1) / np.maximum(finite.sum(axis=1), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.where(mean > 0, to_decibels(mean), np.nan)
    return level, side


def joint_levels(
    predictor: Predictor, places: np.ndarray, stations: np.ndarray
) -> np.ndarray | None:
    """Return levels, deviations [dB] and correlations with the strongest, (n, 3, T), at world
    places (n, 3) [m].

    Args:
        predictor: see `Predictor.joint`.
        places: of the moving end.
        stations: (T,) numbers.

    Returns:
        None where each station is by itself.
    """
    prediction = predictor.predict_joint(places, stations)
    if prediction is None:
        return None
    level, covariance, _ = prediction
    spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    # Of the correlations only those with the strongest decide which station serves.
    row, first = np.arange(len(level)), level.argmax(1)
    alike = covariance[row, first] / (spread * spread[row, first][:, None])
    return np.stack([level, spread, alike], 1)

"""How surely a share of a map's squares is covered: near squares share their errors,
and regions that nobody walked some more.
"""

from __future__ import annotations

import numpy as np
import torch

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.joint_errors import RegionErrors, model_correlations
from gsparc.apps.maps.promise import Promise
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import to_local
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.uncertainty import central_interval, standard_error

SQUARES, STRONGEST, DRAWS = 300, 4, 400  # drawn together: squares, stations in each, times
SHARE = 0.9


def covered_share_interval(
    field: FieldMap, predictor: Predictor, promise: Promise
) -> tuple[float, float]:
    """Return the ends of the 90 % interval of the share of predicted squares
    that some station covers.

    Args:
        field: a map with `threshold_db`.
        predictor, promise: that it was made with, see `predict_map`.
    """
    _, best = sample_strongest_levels(field, predictor, promise)
    return share_between((best >= field.threshold_db).mean(0), 1 - np.nanmean(field.outage))


def sample_strongest_levels(
    field: FieldMap, predictor: Predictor, promise: Promise | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return squares (n,) of a thinned grid, and the strongest station's level there,
    drawn (n, DRAWS) [dB].

    Errors of the strongest stations are drawn together, by the model's own covariance and what
    regions share (`RegionErrors`), each as large as held-out rows say. See
    `covered_share_interval`; without a promise only each square's own spread is right.
    """
    level, error = (
        layer.reshape(len(layer), -1) for layer in (field.power_db, field.expected_error_db)
    )
    cells = np.flatnonzero(np.isfinite(level).any(0))
    square = cells[evenly_spaced(len(cells), SQUARES)]
    few = np.nan_to_num(level[:, square].astype(np.float64), nan=-np.inf)
    station = np.argsort(-few, axis=0)[:STRONGEST]
    rank, at = np.nonzero(np.isfinite(np.take_along_axis(few, station, axis=0)))
    station = station[rank, at]
    places, spread = field.grid.places(square)[at], error[station, square[at]]
    # The mean of all errors is known no better than the blocks tell it:
    # the correlations hold none of it.
    block_m, common = (
        (1.0, 0.0) if promise is None else (promise.block_m, standard_error_of_bias(promise) ** 2)
    )
    number, region = field.number[station], RegionErrors.from_promise(promise)
    alike = model_correlations(predictor, places, number, block_m)
    if promise is not None:
        far = promise.distances(to_local(predictor.site, places, None), number)
        alike = region.correlations(alike, places, number, far)
    errors = sample_errors(np.outer(spread, spread) * alike + common)
    if region.quarters:  # few of them tell how large a region's error is
        loose = np.random.default_rng(1).chisquare(region.quarters, DRAWS)
        errors = errors * np.sqrt(region.quarters / loose)
    drawn = few[station, at][:, None] + errors
    best = np.full((len(square), DRAWS), -np.inf)
    np.maximum.at(best, at, drawn)
    return square, best


def sample_errors(covariance: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return normal errors (n, DRAWS) of a covariance (n, n),
    whose diagonal may be short of rounding.
    """
    covariance = covariance + 1e-6 * covariance.diagonal().max() * np.eye(len(covariance))
    lower = Factor.from_gram(torch.from_numpy(covariance)).lower.numpy()
    return np.asarray(lower @ np.random.default_rng(seed).normal(size=(len(covariance), DRAWS)))


def share_between(drawn: np.ndarray, expected: float) -> tuple[float, float]:
    """Return the ends of the 90 % interval of a share (DRAWS,),
    about what all squares expect of it.
    """
    low, high = (end - float(drawn.mean()) + expected for end in central_interval(drawn, SHARE))
    return max(low, 0.0), min(high, 1.0)


def standard_error_of_bias(promise: Promise) -> float:
    """Return the standard error of the mean error of measured rows, over held-out blocks [dB]."""
    heard = promise.evidence.subset(promise.evidence.heard)
    return standard_error(heard.level_db - heard.mean_db, heard.block)

"""What a model does not know yet: covariances of its errors between places, station by station."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from gsparc.apps.maps.joint_errors import RegionErrors
from gsparc.apps.maps.making import choose_stations
from gsparc.apps.maps.promise import Promise
from gsparc.prediction.levels import predict_levels
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import query_ends, to_local

BETWEEN = (0.25, 1.0)  # what held-out blocks may multiply a measurement's scatter with
LEAST_FIELD = 0.05  # of a tested squared error, that more rows can take away
DRAWS = 200  # of levels, that tell how likely a station is the strongest
# Before anything is measured: deviation, and noise relative to its square
SHADOWING_DB, NOISE = 6.0, 0.1
# Of the longer side: the length over which powers are alike, where nobody says it
SHARE_OF_SIDE = 0.15


@dataclass
class ErrorCovariance:
    """Errors at S places, all variances in dB^2.

    Attributes:
        covariance: (S, S) of the power without a measurement's own noise; changes as places are
            measured.
        noise: variance of one measurement.
        measured: (S,) the same of a measurement at each place, infinite where it would not list the
            station.
        weight: (S,) what variances count, see `weigh_goal`.
    """

    covariance: np.ndarray
    noise: float
    measured: np.ndarray
    weight: np.ndarray

    def condition_on(self, place: int) -> None:
        """Condition on a measurement at one of the places."""
        column = self.covariance[:, place].copy()
        self.covariance -= np.outer(column, column / (column[place] + self.measured[place]))

    def variance_reductions(self, targets: np.ndarray) -> np.ndarray:
        """Return what a measurement at each place takes off the sum of variances at `targets` (S,)
        bool.
        """
        explained = (self.weight * targets) @ self.covariance**2
        return explained / (np.maximum(self.covariance.diagonal(), 0) + self.measured)

    def variances(self) -> np.ndarray:
        """Return variances of a measurement's error at each place (S,), weighed."""
        return self.weight * (np.maximum(self.covariance.diagonal(), 0) + self.noise)


def error_covariances(
    predictor: Predictor,
    places: np.ndarray,
    stations: Sequence[str],
    promise: Promise | None,
    other_end: Sequence[float] | None = None,
    goal: str = "all",
    threshold_db: float | None = None,
) -> list[ErrorCovariance]:
    """Return error covariances at world places (S, 3) [m] of every station, by its process.

    They are as large as held-out rows of `promise` say, and share what regions do; what shall be
    known weighs them, see `weigh_goal`. What is measured at a place lists those that are predicted
    strongest there, as many as training rows have in the mean.

    Raises:
        ValueError: the model has no process.
    """
    covariances, all_names = [], choose_stations(predictor, None)[0]
    names = predictor.site.every_station.name
    ask = {name: predictor.ask_station(names.index(name)) for name in all_names}
    answers = {name: predict_levels(ask[name], places, other_end) for name in all_names}
    each = len(all_names) if promise is None else min(promise.stations_of_place(), len(all_names))
    level = np.nan_to_num([answers[name][0] for name in all_names], nan=-np.inf)
    listed = (level >= np.sort(level, 0)[-each]).T
    more = predictor.noise_by_others(places, [names.index(name) for name in all_names], listed).T
    levels, spreads = np.array([answers[name] for name in stations]).swapaxes(0, 1)
    region = RegionErrors.from_promise(promise)
    for name, worth in zip(stations, weigh_goal(levels, spreads, goal, threshold_db), strict=True):
        number, asking = names.index(name), ask[name]
        covariance, noise = asking.covariance(**query_ends(asking.site, places, other_end))
        scatter = noise
        if promise is not None:
            far = promise.distance(to_local(asking.site, places, other_end), number)
            covariance, scatter = _as_tested(
                covariance, noise, promise, region, places, number, far, answers[name][1]
            )
        # A place tells no more than its scatter allows, and less where it does not list the station
        measured = scatter + more[all_names.index(name)]
        covariances.append(ErrorCovariance(covariance, scatter, measured, worth))
    return covariances


def _as_tested(
    covariance: np.ndarray,
    noise: float,
    promise: Promise,
    region: RegionErrors,
    places: np.ndarray,
    number: int,
    far: np.ndarray,
    spread_db: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Covariance (S, S) of a station's level as large as held-out rows say, with what regions
    share, and a measurement's scatter; `far` (S,) from what was measured [m].
    """
    calibration, station = promise.calibration(), np.full(len(far), number)
    # Beyond its reach as at its edge
    inside = np.minimum(far, calibration.reach)
    error = calibration.half_and_error(spread_db, inside, station)[1]
    stated = np.maximum(covariance.diagonal(), 1e-9)
    total = np.where(np.isfinite(error), error**2, stated + noise)
    # Near rows nothing but scatter is left: there tested errors say how large it is.
    scatter = float(noise * np.clip(np.min(total / (stated + noise)), *BETWEEN))
    field = np.sqrt(np.maximum(total - scatter, LEAST_FIELD * total))
    alike = covariance / np.sqrt(np.outer(stated, stated))
    alike = region.correlations(alike, places, station, inside)
    return np.outer(field, field) * alike, scatter


def weigh_goal(
    level_db: np.ndarray, spread_db: np.ndarray, goal: str, threshold_db: float | None = None
) -> np.ndarray:
    """Return weights (T, S), of mean 1, of variances of T stations at S places.

    Of goal `strongest` the chance of each to be that; with a threshold times the variance of
    whether one reaches it.

    >>> weigh_goal(np.array([[-60.0], [-90.0]]), np.ones((2, 1)), "strongest").ravel()
    array([2., 0.])
    """
    if goal == "all" and threshold_db is None:
        return np.ones_like(level_db)
    rng, wins, reached = (
        np.random.default_rng(0),
        np.zeros(level_db.shape),
        np.zeros(level_db.shape[1]),
    )
    mean, spread, at = (
        np.nan_to_num(level_db, nan=-np.inf),
        np.nan_to_num(spread_db),
        np.arange(len(reached)),
    )
    for _ in range(DRAWS):
        drawn = mean + spread * rng.normal(size=mean.shape)
        wins[drawn.argmax(0), at] += 1
        reached += drawn.max(0) >= (np.inf if threshold_db is None else threshold_db)
    weight = wins * (reached * (DRAWS - reached) + 1)  # at no place none
    return np.asarray(weight / weight.mean())


def prior_covariances(places: np.ndarray, length_m: float | None) -> list[ErrorCovariance]:
    """Return the same where nothing was measured: shadowing about a level nobody knows, alike over
    `length_m`, else `SHARE_OF_SIDE` of the longer side of places (S, 3) [m].
    """
    length = length_m or max(float(np.ptp(places, axis=0).max()) * SHARE_OF_SIDE, 1e-6)
    variance, scaled = SHADOWING_DB**2, np.sqrt(3) * cdist(places, places) / length
    # Matern-3/2 about a level that is as uncertain: Rasmussen and Williams 2006, eq. 4.17.
    prior = variance * ((1 + scaled) * np.exp(-scaled) + 1)
    ones = np.ones(len(places))
    return [ErrorCovariance(prior, variance * NOISE, variance * NOISE * ones, ones)]

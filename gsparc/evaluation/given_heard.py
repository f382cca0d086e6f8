"""Levels given that they are heard: what is asked of rows of surveys, which hold what is strong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
import torch
from scipy.spatial import cKDTree

from gsparc.data.links.strongest import StrongestLists, levels_db
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.units import power_in_decibels
from gsparc.models.method import Method
from gsparc.models.per_station import UNHEARD, PerStation
from gsparc.processes.censored import truncated_moments

NEAREST = 30  # silent rows of a station
DRAWS = 100  # of the levels of all that may be listed
FARTHEST = -8.0  # deviations below its limit that a predicted level is clamped at


def levels_given_heard(
    method: Method, learned: Measurements, asked: Measurements, mean_db: np.ndarray, spread_db: np.ndarray,
    lists: StrongestLists | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return the probability (n,) of being heard, mean and deviation (n,) [dB] of levels that are, by name.

    What a level must exceed is drawn: in lists of the N strongest, where the method learned from unlisted
    rows, the N-th strongest of the other stations as the method predicts them; elsewhere levels of the
    station's nearest silent rows. Levels are normal, and those that are heard the part above (J. Heckman,
    "Sample selection bias as a specification error", Econometrica 47 (1979)). Where a station was never
    silent levels stay as they are, and the probability is NaN.

    Args:
        method: fitted.
        learned: rows that it learned from.
        asked: n rows, in its coordinates.
        mean_db, spread_db: (n,) of levels, heard or not; where these are NaN they stay.
        lists: of the strongest, that the learned rows are; None: they are none.
    """
    level = levels_db(learned, np.arange(len(learned)))
    silent = learned.censored_side() > 0
    mine, learned_station = asked.stations_of(), learned.stations_of()
    uses_silence = method.uses_censored and (spread_db > 0).any()
    others = _draw_others(method, lists, asked, mine) if uses_silence and lists is not None else None
    chance, mean, spread = np.full(len(asked), np.nan), mean_db.copy(), spread_db.copy()
    for station in np.intersect1d(mine, learned_station[silent]):
        at = np.flatnonzero((mine == station) & (spread_db > 0))
        rows = np.flatnonzero(silent & (learned_station == station))
        if others is None:
            near = cKDTree(learned.moving[rows]).query(
                asked.moving[at], range(1, min(NEAREST, len(rows)) + 1)
            )
            limit = level[rows[near[1]]]
        else:  # what is below all that is listed is in no list
            limit = np.maximum(others[at], level[rows].min())
        above = torch.from_numpy((mean_db[at, None] - limit) / spread_db[at, None]).clamp_min(FARTHEST)
        chance[at] = torch.special.ndtr(above).mean(1)
        # Each limit counts by how probable it makes that the row is heard.
        weight = torch.softmax(torch.special.log_ndtr(above), 1)
        shift, variance_loss = truncated_moments(above)
        middle = (weight * shift).sum(1)
        mean[at] += spread[at] * middle.numpy()
        spread[at] *= ((weight * (1 - variance_loss + shift**2)).sum(1) - middle**2).sqrt().numpy()
    return {"heard_share": chance, "heard_db": mean, "heard_std_db": spread}


def _draw_others(method: Method, lists: StrongestLists, asked: Measurements, mine: np.ndarray) -> np.ndarray:
    """Draws (n, DRAWS) of the level [dB] of the other station that fills the list.

    Args:
        method: states variances.
        lists: of the rows that it learned from.
        asked, mine: n rows, and their stations (n,).
    """
    places, which = np.unique(asked.moving, axis=0, return_inverse=True)
    result, rank = np.empty((len(asked), DRAWS)), -lists.length
    for place, drawn in enumerate(_draw_levels(_levels_near(method, lists, asked.site, places))):
        rows = which.reshape(-1) == place
        beyond, last = np.partition(drawn, (rank - 1, rank), axis=0)[[rank - 1, rank]]
        # One that has a place itself leaves the others one less.
        result[rows] = np.where(drawn[mine[rows]] >= last, beyond, last)
    return result


def _draw_levels(level: np.ndarray) -> Iterator[np.ndarray]:
    """Draws (T, DRAWS) [dB] at each of M places, of levels with their deviations (2, M, T)."""
    rng = np.random.default_rng(0)
    for mean, spread in level.swapaxes(0, 1)[..., None]:
        yield mean + spread.clip(0) * rng.normal(size=(len(mean), DRAWS))


def _levels_near(method: Method, lists: StrongestLists, site: Site, places: np.ndarray) -> np.ndarray:
    """Levels and deviations (2, M, T) [dB] of stations listed near places (M, 3); -inf of others."""
    stations = {number for number, _ in method} if isinstance(method, PerStation) else {UNHEARD}
    answered = np.array([t in stations or UNHEARD in stations for t in range(lists.level.shape[1])])
    station, at = np.nonzero((lists.listed_near(places) & answered).T)
    level = np.full((2, len(places), len(answered)), -np.inf)
    if not len(at):
        return level
    query = Query.from_places(site, torch.from_numpy(places[at]).float(), torch.from_numpy(station))
    prediction = method.predict(query)
    variance = torch.zeros(len(at)) if prediction.variance is None else prediction.variance
    power = prediction.mean[:, 0].double().numpy() * site.target_scale
    with np.errstate(divide="ignore", invalid="ignore"):  # of no power, which has no decibels
        level[:, at, station] = power_in_decibels(power, variance.double().numpy() * site.target_scale**2)
    return level


def never_listed(
    method: Method, lists: StrongestLists, data: Measurements, asked: Measurements
) -> pd.DataFrame:
    """Return how probably lists hold stations that none of them does: columns `station`, `moment`, `share`.

    Of every moment that was asked about, not of a choice of unlisted rows; levels are drawn as the method
    predicts them. Empty of methods that do not know what lists leave out.

    Args:
        method: fitted.
        lists: of the rows that it learned from.
        data, asked: all rows that are scored, and some of them, in its coordinates.
    """
    table = pd.DataFrame({"station": [], "moment": [], "share": []}, dtype=float)
    if not method.uses_censored:
        return table
    assert asked.place is not None
    heard = data.stations_of()[data.censored_side() <= 0]
    absent = np.setdiff1d(np.flatnonzero(np.isfinite(lists.level).any(0)), heard)
    if not len(absent):
        return table
    moment, first = np.unique(asked.place, return_index=True)
    draws = _draw_levels(_levels_near(method, lists, asked.site, asked.moving[first]))
    parts, floor = [table], np.nanmin(lists.level)
    for here, drawn in zip(moment, draws, strict=True):
        last = np.partition(drawn, -lists.length, axis=0)[-lists.length]
        share = (drawn[absent] >= np.maximum(last, floor)).mean(1)
        parts.append(pd.DataFrame({"station": absent, "moment": here, "share": share}))
    return pd.concat(parts)


def strongest_told(method: Method, lists: StrongestLists, asked: Measurements) -> np.ndarray:
    """Return at rows (n,) of moments whether the measured strongest station is the predicted one of all.

    Every station that was listed nearby is asked about, listed here or not: what a list of the strongest
    leaves out is weaker. Of k stations tied as predicted strongest a right one counts 1 / k.
    """
    assert asked.place is not None
    _, first, which = np.unique(asked.place, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    if method.name == "nearest":  # the nearest moment as it was, not each station's own
        finite = np.isfinite(lists.place).all(1)
        level = lists.level[finite][cKDTree(lists.place[finite]).query(asked.moving[first])[1]]
        level = np.nan_to_num(level, nan=-np.inf)
    else:
        level = _levels_near(method, lists, asked.site, asked.moving[first])[0]
    measured = np.full(level.shape, -np.inf)
    heard = np.flatnonzero(asked.censored_side() <= 0)
    np.maximum.at(measured, (which[heard], asked.stations_of(heard)), levels_db(asked, heard))
    best, predicted_best = (one == one.max(1, keepdims=True) for one in (measured, level))
    predicted_best &= np.isfinite(level)
    share = (best & predicted_best).sum(1) / np.maximum(predicted_best.sum(1), 1)
    return np.where(np.isfinite(measured.max(1)), share, np.nan)[which]


def levels_of_nearest_moment(learned: Measurements, asked: Measurements) -> np.ndarray:
    """Return levels (n,), linear, of stations of rows asked at the nearest place learned from; 0 if unheard.

    The strongest of the nearest moment, as anyone would tell a best server; levels of each station's own
    nearest moments tell it worse (simulated lists of three .30 to .36 for .48 to .76 of the places).
    """
    station, heard = asked.stations_of(), np.flatnonzero(learned.censored_side() <= 0)
    places, which = np.unique(learned.moving[heard], axis=0, return_inverse=True)
    table = np.zeros((len(places), max(learned.stations_of().max(), station.max()) + 1))
    np.maximum.at(table, (which.reshape(-1), learned.stations_of(heard)), learned.target[heard, 0])
    return table[cKDTree(places).query(asked.moving)[1], station]

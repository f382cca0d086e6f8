"""Levels given that they are heard: what is asked of rows of surveys, which hold what is strong."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsparc.data.links.strongest import StrongestLists
from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.units import power_in_decibels
from gsparc.models.method import Method
from gsparc.models.per_station import UNHEARD, PerStation
from gsparc.processes.censored import truncated_moments

NEAREST = 30  # silent rows of a station
DRAWS = 100  # of the levels of all that may be listed
FARTHEST = -8.0  # deviations below its limit that a predicted level is clamped at


def levels_given_heard(
    method: Method, learned: Measurements, asked: Measurements, mean_db: np.ndarray, spread_db: np.ndarray
) -> dict[str, np.ndarray]:
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
    """
    level = 10 * np.log10(learned.target[:, 0].astype(float) * learned.site.target_scale)
    silent = learned.censored_side(np.arange(len(learned))) > 0
    mine, own = (np.zeros(len(d), int) if d.station is None else d.station for d in (asked, learned))
    others, told = None, method.uses_censored and (spread_db > 0).any()
    if told and learned.place is not None and learned.site.stations is not None:
        heard = learned.place[~silent], own[~silent], level[~silent], learned.moving[~silent]
        lists = StrongestLists.from_rows(*heard, len(learned.site.stations))
        others = _draw_others(method, lists, asked, mine) if lists.are_strongest() else None
    chance, mean, spread = np.full(len(asked), np.nan), mean_db.copy(), spread_db.copy()
    for station in np.intersect1d(mine, own[silent]):
        at = np.flatnonzero((mine == station) & (spread_db > 0))
        rows = np.flatnonzero(silent & (own == station))
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
        shift, lost = truncated_moments(above)
        middle = (weight * shift).sum(1)
        mean[at] += spread[at] * middle.numpy()
        spread[at] *= ((weight * (1 - lost + shift**2)).sum(1) - middle**2).sqrt().numpy()
    return {"heard_share": chance, "heard_db": mean, "heard_std_db": spread}


def _draw_others(method: Method, lists: StrongestLists, asked: Measurements, mine: np.ndarray) -> np.ndarray:
    """Draws (n, DRAWS) of the level [dB] of the other station that fills the list.

    Args:
        method: states variances.
        lists: of the rows that it learned from.
        asked, mine: n rows, and their stations (n,).
    """
    places, which = np.unique(asked.moving, axis=0, return_inverse=True)
    known = {number for number, _ in method} if isinstance(method, PerStation) else {UNHEARD}
    count = lists.level.shape[1]
    answered = np.array([t in known or UNHEARD in known for t in range(count)])
    station, at = np.nonzero((lists.listed_near(places) & answered).T)
    query = Query.from_places(asked.site, torch.from_numpy(places[at]).float(), torch.from_numpy(station))
    said, unit = method.predict(query), asked.site.target_scale
    assert said.variance is not None
    power, variance = said.mean[:, 0].double().numpy() * unit, said.variance.double().numpy() * unit**2
    level = np.full((2, len(places), count), -np.inf)  # and deviation
    level[:, at, station] = power_in_decibels(power, variance)
    rng, result, kept = np.random.default_rng(0), np.empty((len(asked), DRAWS)), -lists.length
    for place in range(len(places)):
        rows = which.reshape(-1) == place
        mean, spread = level[:, place, :, None]
        drawn = mean + spread.clip(0) * rng.normal(size=(count, DRAWS))
        beyond, last = np.partition(drawn, (kept - 1, kept), axis=0)[[kept - 1, kept]]
        # One that has a place itself leaves the others one less.
        result[rows] = np.where(drawn[mine[rows]] >= last, beyond, last)
    return result


def levels_of_nearest_moment(learned: Measurements, asked: Measurements) -> np.ndarray:
    """Return levels (n,), linear, of stations of rows asked at the nearest place learned from; 0 if unheard.

    The strongest of the nearest moment, as anyone would tell a best server; levels of each station's own
    nearest moments tell it worse (simulated lists of three .30 to .36 for .48 to .76 of the places).
    """
    assert learned.station is not None and asked.station is not None
    heard = np.flatnonzero(learned.censored_side(np.arange(len(learned))) <= 0)
    places, which = np.unique(learned.moving[heard], axis=0, return_inverse=True)
    table = np.zeros((len(places), max(learned.station.max(), asked.station.max()) + 1))
    np.maximum.at(table, (which.reshape(-1), learned.station[heard]), learned.target[heard, 0])
    return table[cKDTree(places).query(asked.moving)[1], asked.station]

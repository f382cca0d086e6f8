"""Levels given that they are listed: what is asked of rows of lists, which hold what is strong."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsparc.data.links.strongest import StrongestLists, number_lists
from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import LEAST_ROWS
from gsparc.data.units import power_in_decibels
from gsparc.models.method import Method, Prediction
from gsparc.processes.censored import truncated_moments

# Of rows or lists around: 5 had .02 dB more rmse in 14 splits of lists, all of them as much.
NEAREST = 30
DRAWS = 100  # of the levels of all that may be listed
BATCH = 4_096  # queries


def levels_given_heard(
    method: Method, learned: Measurements, asked: Measurements, mean_db: np.ndarray, spread_db: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the probability (n,) of being heard, mean and deviation (n,) [dB] of levels that are, by name.

    What a level must exceed is drawn: in lists of the N strongest, where the method learned from unlisted
    rows, the N-th strongest of the other stations as the method predicts them; elsewhere levels of the
    station's nearest silent rows. Levels are normal, and those that are listed the part above (J. Heckman,
    "Sample selection bias as a specification error", Econometrica 47 (1979)). Without lists they stay as they
    are: floors of stations are often guesses (real Wi-Fi: given that they are heard 4.08 for 3.87 dB).
    Where a station was never silent the probability is NaN.

    Args:
        method: fitted.
        learned: rows that it learned from.
        asked: n rows, in its coordinates.
        mean_db, spread_db: (n,) of levels, heard or not; where these are NaN they stay.
    """
    level = 10 * np.log10(learned.target[:, 0].astype(float) * learned.site.target_scale)
    silent = learned.censored_side(np.arange(len(learned))) > 0
    mine, own = (np.zeros(len(d), int) if d.station is None else d.station for d in (asked, learned))
    lists = _find_lists(learned, level, ~silent) if method.uses_censored else None
    others = None if lists is None else _draw_others(method, lists, learned, asked)
    chance, mean, spread = np.full(len(asked), np.nan), mean_db.copy(), spread_db.copy()
    for station in np.intersect1d(mine, own[silent]):
        at = np.flatnonzero((mine == station) & (spread_db > 0))
        rows = np.flatnonzero(silent & (own == station))
        if others is None:
            near = _find_nearest(learned.moving[rows], asked.moving[at])
            limit = level[rows[near]]
        else:  # what is below all that is listed is in no list
            limit = np.maximum(others[at], level[rows].min())
        above = torch.from_numpy((mean_db[at, None] - limit) / spread_db[at, None])
        chance[at] = torch.special.ndtr(above).mean(1)
        if others is not None:
            # Each limit counts by how probable it makes the list. Above 0 is a mirror image.
            weight = torch.softmax(torch.special.log_ndtr(above), 1)
            shift, lost = truncated_moments(above)
            middle = (weight * shift).sum(1)
            mean[at] += spread[at] * middle.numpy()
            spread[at] *= ((weight * (1 - lost + shift**2)).sum(1) - middle**2).sqrt().numpy()
    return {"heard_share": chance, "heard_db": mean, "heard_std_db": spread}


def _find_nearest(places: np.ndarray, asked: np.ndarray) -> np.ndarray:
    return cKDTree(places).query(asked, range(1, min(NEAREST, len(places)) + 1))[1]


def _find_lists(learned: Measurements, level: np.ndarray, heard: np.ndarray) -> StrongestLists | None:
    """Lists of the strongest of heard rows; None where they are none."""
    if learned.station is None or learned.place is None or learned.site.stations is None:
        return None
    place, who, at = learned.place[heard], learned.station[heard], learned.moving[heard]
    count = len(learned.site.stations)
    lists = StrongestLists.from_rows(number_lists(place, who), who, level[heard], at, count)
    return lists if lists.are_strongest() else None


def _draw_others(
    method: Method, lists: StrongestLists, learned: Measurements, asked: Measurements
) -> np.ndarray:
    """Draws (n, DRAWS) of the level [dB] of the other station that fills the list."""
    places, which = np.unique(asked.moving, axis=0, return_inverse=True)
    near = _find_nearest(lists.place, places)
    enough = np.bincount(learned.station, minlength=lists.level.shape[1]) >= LEAST_ROWS
    station, at = np.nonzero((np.isfinite(lists.level[near]).any(1) & enough).T)
    query = Query.from_places(asked.site, torch.from_numpy(places[at]).float(), torch.from_numpy(station))
    said = Prediction.joined([method.predict(part) for part in query.split(BATCH)])
    mean, spread = np.full((2, len(places), len(enough)), np.nan)
    levels = power_in_decibels(said.mean.double().numpy()[:, 0], said.variance.double().numpy())
    mean[at, station], spread[at, station] = levels[0] + 10 * np.log10(asked.site.target_scale), levels[1]
    rng, result = np.random.default_rng(0), np.empty((len(asked), DRAWS))
    order = np.argsort(which, kind="stable")
    for p, rows in enumerate(np.split(order, np.flatnonzero(np.diff(which[order])) + 1)):
        who = np.flatnonzero(np.isfinite(mean[p]))
        drawn = np.full((len(enough), DRAWS), -np.inf)
        drawn[who] = mean[p, who, None] + spread[p, who, None] * rng.normal(size=(len(who), DRAWS))
        few = np.full((lists.length + 1, DRAWS), -np.inf)
        last, beyond = np.sort(np.r_[few, drawn[who]], 0)[[-lists.length, -lists.length - 1]]
        # One that has a place itself leaves the others one less.
        result[rows] = np.where(drawn[asked.station[rows]] >= last, beyond, last)
    return result

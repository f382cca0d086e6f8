"""What lists of the strongest, and the nearest moment, tell of rows that are scored."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gsparc.data.schema import Measurements
from gsparc.models.method import Method
from gsparc.prediction.hearing import Hearing, levels_near
from gsparc.tables.links.strongest import StrongestLists, levels_db


def names_every_station(data: Measurements, rows: np.ndarray) -> bool:
    """Tell whether every station of the file was heard at each place of rows (n,):
    then nothing was chosen.

    Levels of others are what was strong enough to be heard or listed.
    """
    place = np.arange(len(data)) if data.place is None else data.place
    named = data.censored_side(rows) <= 0
    if data.mask is not None:  # saturated rows have no target, but name their station
        named &= data.mask[rows].reshape(len(rows), -1).any(1) | (data.censored_side(rows) < 0)
    links = np.unique(np.c_[place[rows], data.stations_of(rows)][named], axis=0)
    return len(links) == len(np.unique(place[rows])) * len(np.unique(data.stations_of()))


def never_listed(
    method: Method, hearing: Hearing, data: Measurements, asked: Measurements
) -> pd.DataFrame:
    """Return how probably lists hold stations that none of them does: columns `station`, `moment`,
    `share`.

    Of every moment that was asked about, not of a choice of unlisted rows; levels are as the method
    predicts them. Empty of methods that do not know what lists leave out.

    Args:
        method: fitted.
        hearing: what it learned of lists.
        data, asked: all rows that are scored, and some of them, in its coordinates.
    """
    table = pd.DataFrame({"station": [], "moment": [], "share": []}, dtype=float)
    if not method.uses_censored:
        return table
    assert asked.place is not None and hearing.lists is not None
    heard = data.stations_of()[data.censored_side() <= 0]
    absent = np.setdiff1d(np.flatnonzero(np.isfinite(hearing.lists.level).any(0)), heard)
    if not len(absent):
        return table
    moment, first = np.unique(asked.place, return_index=True)
    levels = levels_near(method, hearing.lists, asked.moving[first])
    share = np.zeros((len(moment), len(absent)))
    at, column = np.nonzero(np.isfinite(levels[0][:, absent]))
    own = levels[:, at, absent[column]]
    share[at, column] = hearing.given_listed(levels, own, at, absent[column])[0]
    columns = np.tile(absent, len(moment)), np.repeat(moment, len(absent)), share.ravel()
    return pd.DataFrame(dict(zip(table, columns, strict=True)))


def strongest_told(method: Method, lists: StrongestLists, asked: Measurements) -> np.ndarray:
    """Return at rows (n,) of moments whether the measured strongest station is the predicted one of
    all.

    Every station that was listed nearby is asked about, listed here or not: what a list of the
    strongest leaves out is weaker. Of k stations tied
    as predicted strongest a right one counts 1 / k.
    """
    assert asked.place is not None
    _, first, which = np.unique(asked.place, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    if method.name == "nearest":  # the nearest moment as it was, not each station's own
        finite = np.isfinite(lists.place).all(1)
        level = lists.level[finite][cKDTree(lists.place[finite]).query(asked.moving[first])[1]]
        level = np.nan_to_num(level, nan=-np.inf)
    else:
        level = levels_near(method, lists, asked.moving[first])[0]
    measured = np.full(level.shape, -np.inf)
    heard = np.flatnonzero(asked.censored_side() <= 0)
    np.maximum.at(measured, (which[heard], asked.stations_of(heard)), levels_db(asked, heard))
    best, predicted_best = (levels == levels.max(1, keepdims=True) for levels in (measured, level))
    predicted_best &= np.isfinite(level)
    share = (best & predicted_best).sum(1) / np.maximum(predicted_best.sum(1), 1)
    return np.where(np.isfinite(measured.max(1)), share, np.nan)[which]


def levels_of_nearest_moment(learned: Measurements, asked: Measurements) -> np.ndarray:
    """Return levels (n,), linear, of stations of rows asked at the nearest place learned from;
    0 if unheard.

    The strongest of the nearest moment, as anyone would tell a best server; levels of each
    station's own nearest moments tell it worse (simulated lists of three .30 to .36 for .48
    to .76 of the places).
    """
    station, heard = asked.stations_of(), np.flatnonzero(learned.censored_side() <= 0)
    places, which = np.unique(learned.moving[heard], axis=0, return_inverse=True)
    table = np.zeros((len(places), max(learned.stations_of().max(), station.max()) + 1))
    np.maximum.at(table, (which.reshape(-1), learned.stations_of(heard)), learned.target[heard, 0])
    return table[cKDTree(places).query(asked.moving)[1], station]

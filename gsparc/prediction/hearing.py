"""Levels given that they are heard: what surveys measure, whose rows hold what is strong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import ndtr

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.units import power_in_decibels
from gsparc.models.method import MEAN_DEVICE, Method
from gsparc.models.per_station import PerStation
from gsparc.models.station_sites import UNHEARD
from gsparc.processes.censored import truncated_moments
from gsparc.processes.stored import Stored, from_plain, to_plain
from gsparc.tables.links.strongest import StrongestLists, levels_db, strongest_lists

KEY = "hearing"  # of a checkpoint's `extra`
NEAREST = 30  # silent rows of a station
# Deviations at which a level's probability of being listed is asked
NODES = np.linspace(-4.5, 4.5, 33)
FARTHEST = -8.0  # deviations below its limit that a predicted level is clamped at
TINY_DB = 1e-6  # deviation of a level that a method states none of
RARE = 1e-12  # probability of being listed
BLOCK = 512  # places that are asked about at a time


@dataclass(frozen=True)
class Hearing(Stored):
    """What was not heard among the rows that a model learned from;
    its length is the number of these.

    Attributes:
        place: (n, D) [m, local] of silent rows.
        station: (n,) int64.
        level_db: (n,) which each is below.
        lists: of the strongest, that the rows are; None: they are none.
    """

    place: np.ndarray
    station: np.ndarray
    level_db: np.ndarray
    lists: StrongestLists | None = None

    def __len__(self) -> int:
        return len(self.station)

    @classmethod
    def from_learned(cls, data: Measurements, rows: np.ndarray) -> Self:
        """Return what rows (n,) that are learned from tell of it; nothing where all was heard."""
        rows = np.sort(rows)
        silent = rows[data.censored_side(rows) > 0]
        levels = levels_db(data, silent) if len(silent) else np.zeros(0)
        lists = strongest_lists(data.subset(rows)) if len(silent) else None
        return cls(data.moving[silent], data.stations_of(silent), levels, lists)

    def to_extra(self) -> dict[str, Any]:
        """Return what a checkpoint has as `extra`."""
        return {KEY: to_plain(self)} if len(self) else {}

    def without(self, off: np.ndarray) -> Self:
        """Return the same of lists that none of the stations `off` (k,) fills."""
        if self.lists is None or not len(off):
            return self
        level = self.lists.level.copy()
        level[:, off] = np.nan
        return replace(self, lists=replace(self.lists, level=level))

    def given_heard(
        self,
        method: Method,
        places: np.ndarray,
        mine: np.ndarray,
        mean_db: np.ndarray,
        spread_db: np.ndarray,
        device: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Return the probability (n,) of being heard, mean and deviation (n,)
        [dB] of levels that are.

        What a level must exceed: in lists of the N strongest, where the method learned from
        unlisted rows, the N-th strongest of the other stations as the method predicts them;
        elsewhere levels of the station's nearest silent rows. Levels are normal, and those that are
        heard the part above (J. Heckman, "Sample selection bias as a specification error",
        Econometrica 47 (1979)). Where a station was never silent levels stay as they are,
        and the probability is NaN.

        Args:
            method: fitted.
            places, mine: (n, D) [m, local] that were asked about, and their stations (n,).
            mean_db, spread_db: (n,) of levels, heard or not; where these are NaN they stay.
            device: (n,) which measures there; None: the mean one.
        """
        chance, mean, spread = np.full(len(mine), np.nan), mean_db.copy(), spread_db.copy()
        asked = np.flatnonzero(np.isin(mine, self.station) & (spread_db > 0))
        if self.lists is not None and method.uses_censored:
            device = np.full(len(mine), MEAN_DEVICE) if device is None else device
            moments, which = np.unique(np.c_[places, device][asked], axis=0, return_inverse=True)
            levels = levels_near(
                method, self.lists, moments[:, :-1], moments[:, -1].astype(np.int64)
            )
            own = np.stack([mean_db, spread_db])[:, asked]
            answers = self.given_listed(levels, own, which.reshape(-1), mine[asked])
            chance[asked], mean[asked], spread[asked] = answers
            return {"heard_share": chance, "heard_db": mean, "heard_std_db": spread}
        for station in np.unique(mine[asked]):
            at, rows = asked[mine[asked] == station], np.flatnonzero(self.station == station)
            near = cKDTree(self.place[rows]).query(
                places[at], range(1, min(NEAREST, len(rows)) + 1)
            )[1]
            limit = self.level_db[rows[near]]
            above = torch.from_numpy((mean_db[at, None] - limit) / spread_db[at, None]).clamp_min(
                FARTHEST
            )
            chance[at] = torch.special.ndtr(above).mean(1)
            # Each limit counts by how probable it makes that the row is heard.
            weight = torch.softmax(torch.special.log_ndtr(above), 1)
            shift, variance_loss = truncated_moments(above)
            middle = (weight * shift).sum(1)
            mean[at] += spread[at] * middle.numpy()
            spread[at] *= (
                ((weight * (1 - variance_loss + shift**2)).sum(1) - middle**2).sqrt().numpy()
            )
        return {"heard_share": chance, "heard_db": mean, "heard_std_db": spread}

    def given_listed(
        self, levels: np.ndarray, own: np.ndarray, moment: np.ndarray, station: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the probability (n,) that lists hold a station, its mean and deviation (n,)
        [dB] if they do.

        Args:
            levels: (2, M, T) means and deviations [dB] at M moments, as `levels_near` has them.
            own: (2, n) of the stations that are asked about.
            moment, station: (n,) numbers of these.
        """
        assert self.lists is not None
        # What is below all that is listed is in no list.
        floor = np.full(levels.shape[2], np.inf)
        np.minimum.at(floor, self.station, self.level_db)
        floor[np.isinf(floor)] = -np.inf
        result, step, length = np.empty((3, len(station))), NODES[1] - NODES[0], self.lists.length
        weight = np.exp(-(NODES**2) / 2) / np.exp(-(NODES**2) / 2).sum()
        for some in np.split(np.arange(len(station)), range(BLOCK, len(station), BLOCK)):
            who, (mean, spread) = station[some], own[:, some, None]
            level = mean + spread * NODES
            # Probabilities (b, nodes, N) that so many others are stronger,
            # of independent normal levels.
            stronger = np.zeros((*level.shape, length))
            stronger[..., 0] = np.clip((level - floor[who, None]) / (step * spread) + 0.5, 0, 1)
            for other, (there, doubt) in enumerate(
                zip(*levels[:, moment[some]].swapaxes(1, 2), strict=True)
            ):
                if not np.isfinite(there).any():
                    continue
                away = (there[:, None] - level) / np.maximum(doubt, TINY_DB)[:, None]
                more = np.where(who == other, 0.0, 1.0)[:, None, None] * ndtr(away)[..., None]
                gone = stronger * more
                stronger -= gone
                stronger[..., 1:] += gone[..., :-1]
            listed = weight * stronger.sum(2)
            result[0, some] = listed.sum(1)
            listed[:, -1] += RARE  # what is hardly ever listed is when it is as strong as it may be
            share = listed / listed.sum(1, keepdims=True)
            result[1, some] = middle = (share * level).sum(1)
            result[2, some] = np.sqrt((share * (level - middle[:, None]) ** 2).sum(1))
        return result[0], result[1], result[2]


def read_hearing(extra: Mapping[str, Any]) -> Hearing:
    """Return what a checkpoint holds of it; nothing where all was heard."""
    if KEY in extra:
        result: Hearing = from_plain(extra[KEY])
        return result
    return Hearing(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))


def levels_near(
    method: Method, lists: StrongestLists, places: np.ndarray, device: np.ndarray | None = None
) -> np.ndarray:
    """Return levels and deviations (2, M, T) [dB] of stations listed near places (M, 3);
    -inf of others.

    `device` (M,) is which measures there; None: the mean one, exactly.
    """
    site, stations = method.fitted_site, {UNHEARD}
    if isinstance(method, PerStation):
        stations = {number for number, _ in method}
    answered = np.array([t in stations or UNHEARD in stations for t in range(lists.level.shape[1])])
    station, at = np.nonzero((lists.listed_near(places) & answered).T)
    level = np.full((2, len(places), len(answered)), -np.inf)
    for block in np.split(np.arange(len(at)), range(BLOCK, len(at), BLOCK)) if len(at) else ():
        moment, who = at[block], station[block]
        query = Query.from_places(
            site, torch.from_numpy(places[moment]).float(), torch.from_numpy(who)
        )
        prediction = method.predict(query)
        if device is not None:
            named = torch.from_numpy(device[moment])
            prediction = prediction.of_devices(site, named, torch.from_numpy(who))
        variance = torch.zeros(len(moment)) if prediction.variance is None else prediction.variance
        power = prediction.mean[:, 0].double().numpy() * site.target_scale
        with np.errstate(divide="ignore", invalid="ignore"):  # of no power, which has no decibels
            spread = variance.double().numpy() * site.target_scale**2
            level[:, moment, who] = power_in_decibels(power, spread)
    return level

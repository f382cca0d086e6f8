"""Lists of the strongest: drive tests that list a bounded number of stations at each moment.

A station that a full list leaves out is at most as strong as the weakest that it holds: a level of
its own row. In a list that is not full it is below what the receiver hears.

Where all that is heard is listed, levels end at a floor: they are missing beside weak ones alone.
Levels that were lost, in outages or at random, are missing beside strong ones, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.hashes import hash_rows
from gsparc.data.row_order import morton_codes
from gsparc.physics.decibels import to_decibels
from gsparc.processes.stored import Stored, from_plain, to_plain

if TYPE_CHECKING:
    from gsparc.data.schema import Measurements

FULL = 0.15  # of the moments, that hold as many as any: .03 at most where hearing alone ends lists
LEAST_MOMENTS = 20
ABOVE_DB = 6.0  # of a neighbour's weakest, where a station drops out of lists, at most
WHOLE = 0.5  # of the rows, those of moments that leave none out
ALONE = 0.9  # of the moments, that hold one station where what is logged is the one that serves
SERVED = 0.5  # of what chance leaves, that near moments hold the same one more often
# Near moments of two, at least; what these differ by more than others
SWITCHES, HYSTERESIS_DB = 5, 3.0
RUN = 3  # such moments in a row: how alike neighbours are
NEAREST = 30  # lists that tell which stations may be listed at a place
FLOOR = 2.0  # per cent of a station's levels that may lie below its floor
# Above the floor, at least; and in deviations between neighbouring places
STRONG_DB, SPREADS = 10.0, 3.0
LEAST_LINKS = 30  # of those missing beside levels, and of strong levels
# Share missing beside strong levels, and of strong ones among levels beside missing ones:
# with a floor up to
# .013 and .04 (simulated drives), of outages and random losses .01 to .5 and .3
# to .85 (also POWDER).
LOST, BESIDE_STRONG = 0.02, 0.1


def number_lists(place: np.ndarray, station: np.ndarray) -> np.ndarray:
    """Number (n,) of the list that each row belongs to: rows of one place, in the file's order.

    Args:
        place: (n,) int64, number of each row's place.
        station: (n,) of each row: one that comes again begins another list, unless it comes twice
            in a row.
    """
    first = np.r_[True, np.diff(place) != 0]
    if first.sum() > 2 * len(np.unique(place)):  # not in the order of time
        return np.unique(place, return_inverse=True)[1].reshape(-1)
    number, turn, seen, before = -1, 0, set[int](), None
    result = np.empty((len(place), 2), np.int64)
    for row, (begins, who) in enumerate(zip(first.tolist(), station.tolist(), strict=True)):
        # A station twice in a row is a packet that was logged twice, of a list beside this one.
        turn = turn + 1 if who == before and not begins else 0
        if begins or (who in seen and not turn):
            number, seen = number + 1, set()
        seen.add(who)
        result[row], before = (number, turn), who
    return np.unique(result, axis=0, return_inverse=True)[1].reshape(-1)


Silent = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class StrongestLists(Stored):
    """Lists of the strongest of T stations; of the one that serves a list holds no more.

    Attributes:
        length: stations of a full list; 1 where hardly any holds more.
        first: (M,) a row of each.
        level: (M, T) [dB], NaN where a station is not listed.
        place: (M, 3) [m].
    """

    length: int
    first: np.ndarray
    level: np.ndarray
    place: np.ndarray

    @classmethod
    def from_rows(
        cls, place: np.ndarray, who: np.ndarray, level: np.ndarray, at: np.ndarray, count: int
    ) -> StrongestLists:
        """Build from rows (n,) of numbered places `at` (n, 3) [m], stations `who` of `count`,
        levels [dB].
        """
        lists = number_lists(place, who)
        number, first, which = np.unique(lists, return_index=True, return_inverse=True)
        table = np.full((len(number), count), np.nan)
        table[which.reshape(-1), who] = level
        # By what they hold: the file's order is chance, and draws are by number.
        order = np.lexsort(
            (hash_rows(np.nan_to_num(table)), morton_codes(np.nan_to_num(at[first])))
        )
        sizes = np.isfinite(table).sum(1)
        length = 1 if np.mean(sizes == 1) >= ALONE else int(sizes.max())
        return cls(length, first[order], table[order], at[first[order]])

    def state(self) -> dict[str, Any]:
        """Return what `read` needs: of levels those that are, as most stations are in no list."""
        moment, station = np.nonzero(np.isfinite(self.level))
        levels = np.c_[moment, station], self.level[moment, station], self.level.shape[1]
        return {**super().state(), "level": to_plain(levels)}

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> Self:
        """Return the lists whose `state()` this was."""
        (links, values, count), rest = from_plain(state["level"]), {**state, "level": None}
        lists = super().read(rest)
        level = np.full((len(lists.first), count), np.nan)
        level[tuple(links.T)] = values
        return replace(lists, level=level)

    @property
    def full(self) -> np.ndarray:
        """(M,) bool."""
        return (np.isfinite(self.level).sum(1) >= self.length) & (self.length > 0)

    def are_strongest(self) -> bool:
        """Tell whether many hold as many as any, fewer than there are,
        and stations drop out when weak.

        Stations of one place alone are missing elsewhere whatever ends a list: they are not asked.
        """
        of_places = [
            len(np.unique(self.place[rows], axis=0)) > 1 for rows in np.isfinite(self.level).T
        ]
        if not all(of_places):
            level = self.level[:, of_places]
            length = min(self.length, int(np.isfinite(level).sum(1).max(initial=0)))
            return replace(self, level=level, length=length).are_strongest()
        sizes = np.isfinite(self.level).sum(1)
        piled = self.full.mean() >= FULL and 2 * self.full.sum() > (sizes == self.length - 1).sum()
        if len(sizes) < LEAST_MOMENTS or not 1 <= self.length < self.level.shape[1] or not piled:
            return False
        if self.length == 1:
            return self.serve_one()
        above = self.beside - np.nanmin(self.level, 1)[:, None]
        above = above[np.isnan(self.level) & self.full[:, None] & np.isfinite(above)]
        return bool(len(above) and np.median(above) <= ABOVE_DB)

    def serve_one(self) -> bool:
        """Tell whether the one station of a moment is its strongest: a log of the serving cell.

        Near moments then mostly hold the same, and where they do not both are about as strong: what
        is measured one after the other, or where somebody chose to, changes more often and by more.
        """
        own, near = np.isfinite(self.level), np.isfinite(self.beside)
        moments = np.flatnonzero(own.any(1) & near.any(1))
        same = (own & near)[moments].any(1)
        share = own[moments].mean(0)
        change = np.abs(np.nanmax(self.beside[moments], 1) - np.nanmax(self.level[moments], 1))
        chance = float((share**2).sum())
        if same.mean() - chance < SERVED * (1 - chance) or (~same).sum() < SWITCHES:
            return False
        return bool(np.median(change[~same]) <= np.median(change[same]) + HYSTERESIS_DB)

    @cached_property
    def beside(self) -> np.ndarray:
        """(M, T) levels at the nearest other place, NaN where there are none."""
        moments = np.flatnonzero(np.isfinite(self.place).all(1))
        places, first, which = np.unique(
            self.place[moments], axis=0, return_index=True, return_inverse=True
        )
        result = np.full(self.level.shape, np.nan)
        if len(places) > 1:
            near = cKDTree(places).query(places, k=2)[1][:, 1]
            result[moments] = self.level[moments[first[near[which.reshape(-1)]]]]
        return result

    def strong_beside(self, floor: np.ndarray) -> np.ndarray:
        """Return which of `beside`, (M, T), are well above floors (T,) [dB]."""
        differences = np.abs(self.level - self.beside)
        spread = 1.4826 * float(np.nanmedian(differences if np.isfinite(differences).any() else 0))
        return self.beside > floor + max(STRONG_DB, SPREADS * spread)

    def short_are_lost(self, floor: np.ndarray) -> bool:
        """Tell whether lists that are not full lack stations that are strong beside them,
        as in outages.
        """
        missing = np.isnan(self.level) & ~self.full[:, None] & np.isfinite(self.beside)
        return bool((missing & self.strong_beside(floor)).sum() > BESIDE_STRONG * missing.sum())

    def below_floor(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return floors (T,) [dB] and which links (M, T) lie below;
        None where missing ones look lost.

        A link beside a strong one, and a station with several of these,
        are taken as lost in any case.
        """
        missing, floor = np.isnan(self.level), np.full(self.level.shape[1], np.nan)
        heard = ~missing.all(0)
        floor[heard] = np.nanpercentile(self.level[:, heard], FLOOR, axis=0)
        strong = self.strong_beside(floor)
        edges, strong_gaps = missing & np.isfinite(self.beside), missing & strong
        if min(edges.sum(), strong.sum()) < LEAST_LINKS:
            return None
        if strong_gaps.sum() > min(LOST * strong.sum(), BESIDE_STRONG * edges.sum()):
            return None
        several = (strong_gaps.sum(0) > 1) & (strong_gaps.sum(0) > BESIDE_STRONG / 2 * edges.sum(0))
        return floor, missing & ~strong & heard & ~several

    def listed_near(self, places: np.ndarray) -> np.ndarray:
        """Return which stations (n, T) any of the lists nearest to places (n, 3) [m] holds."""
        has_fix = np.isfinite(self.place).all(1)
        listed, result = (
            np.isfinite(self.level[has_fix]),
            np.zeros((len(places), self.level.shape[1]), bool),
        )
        near = cKDTree(self.place[has_fix]).query(places, range(1, min(NEAREST, len(listed)) + 1))[
            1
        ]
        for square in near.T:  # together they would take much memory
            result |= listed[square]
        return result

    def bound_unlisted(self, floor: np.ndarray, most: int, may: np.ndarray) -> Silent:
        """Return moments (m,), stations (m,) and levels (m,) [dB] that these are below.

        Half of them are all that some moments leave out, spread over the drive: only those tell how
        strong stations are that are seldom listed. The rest are drawn,
        first of stations that are listed nearby.

        Args:
            floor: (T,) level of lists that are not full [dB].
            most: of all.
            may: (M, T) which links, none with a level.
        """
        below = np.where(self.full[:, None], np.nanmin(self.level, 1)[:, None], floor)
        has_fix = np.isfinite(self.place).all(1)
        whole = max(round(WHOLE * most / (self.level.shape[1] - self.length)), 1)
        start = np.linspace(0, len(self.level) - RUN, max(whole // RUN, 1)).astype(np.int64)
        turn = np.random.default_rng(0).random(may.shape)
        turn[has_fix] += self.listed_near(self.place[has_fix])
        turn[start[:, None] + np.arange(RUN)] = np.inf
        links = np.flatnonzero(may & has_fix[:, None])
        links = np.sort(links[np.argsort(-turn.flat[links], kind="stable")[:most]])
        moment, station = np.unravel_index(links, may.shape)
        return moment, station, below[moment, station]


def strongest_lists(data: Measurements) -> StrongestLists | None:
    """Return what is listed at each moment, where these are lists of the strongest;
    None elsewhere.
    """
    if data.place is None or data.station is None or not data.site.several:
        return None
    heard = np.flatnonzero(data.censored_side() <= 0)
    if not len(heard):
        return None
    level, at = levels_db(data, heard), data.moving[heard]
    count = len(data.site.every_station)
    lists = StrongestLists.from_rows(data.place[heard], data.station[heard], level, at, count)
    return lists if lists.are_strongest() else None


def levels_db(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return levels (n,) [dB] of rows of powers."""
    return to_decibels(data.powers(rows)[:, 0])

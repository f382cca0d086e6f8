"""Whether the world still is as a map and later rows say: a sequential test of each station.

While nothing changes, rows are as likely as the rows before them say. An e-detector multiplies how
much likelier they are in a world that changed, whose kinds are those of the map's own update, and
sums over all times of change (the recursion of Shiryaev and Roberts; J. Shin, A. Ramdas, A.
Rinaldo, arXiv:2203.03532). That sum, less the number of rows, is a martingale without change, for
all stations together: an alarm where it exceeds the stated number of rows keeps the mean number of
rows to a false alarm above it. A change is named by what it does to predictions, and what came
before it tells no more. Of a changed world the next change is sought alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.processes.changes import (
    NAMED,
    NOISY,
    SAME,
    SHARE,
    change_log_evidence,
    common_offset,
    correct,
    learn_changes,
    main_effect,
)
from gsparc.processes.later_rows import LaterRows
from gsparc.processes.places import first_end, horizontal
from gsparc.processes.stored import Stored

ROWS = 10_000  # readings to a false alarm, at least, in the mean
TOGETHER = 8  # rows of a station that are tested at a time
LOOKED = 32  # rows near new ones that tell of them
UNLIKELY = -3.0  # log ratio below which what seemed to begin has not
AGAIN = 4  # power of the rows to a false alarm of a changed world: rows tell of it, no map
# Two deviations of what stations of unchanged buildings differ by from survey to survey [dB]
UNUSUAL = 3.0
SILENT = 0.5  # share of rows since a change in which a station is not heard any more: it is gone
RETURNED = "returned"  # the kind of an alarm with which a station is as the map says again


@dataclass(frozen=True)
class Alarm(Stored):
    """A change that was noticed.

    Attributes:
        station: its number; -1: all alike, as of another device.
        kind: `device`, `offset`, `local`, `moved` or `gone`; `returned`: as the map says again.
        since, at: numbers of the rows it seems to have begun with, and that raised the alarm.
        change_db: what is added to predictions where the change is.
        place: (2,) middle of where that is, local [m].
    """

    station: int
    kind: str
    since: int
    at: int
    change_db: float
    place: tuple[float, float]


@dataclass(frozen=True)
class Watch(Stored):
    """State of the test.

    Attributes:
        detector: (T,) logarithms of detectors of stations.
        total: (T,) log ratio of what may be a change since it began.
        since: (T,) number of the first row of that.
        begun: (T,) number of the first row that counts; what came before is of another world.
        alarms: all.
    """

    detector: np.ndarray
    total: np.ndarray
    since: np.ndarray
    begun: np.ndarray
    alarms: tuple[Alarm, ...] = ()

    @classmethod
    def from_site(cls, site: Site) -> Watch:
        """Return one that has seen nothing."""
        since, begun = np.zeros((2, len(site.every_station)), np.int64)
        return cls(np.full(len(since), -np.inf), np.zeros(len(since)), since, begun)

    @classmethod
    def read(cls, state: Mapping[str, object]) -> Watch:
        """Return that of a file; of an older one's test the alarms and beginnings are left."""
        watch = super().read({name: state[name] for name in cls.__annotations__})
        new = np.full(len(watch.begun), -np.inf), np.zeros(len(watch.begun)), watch.begun
        return watch if watch.detector.ndim == 1 else cls(*new, watch.begun, watch.alarms)

    def look(
        self, stations: Mapping[int, LaterRows], first: int, extent: float, rows: float = ROWS
    ) -> Watch:
        """Return the state after rows from number `first` on.

        Args:
            stations: later rows of each, the new ones among them.
            first: number of the first new row.
            extent: of the site [m].
            rows: to a false alarm, at least, in the mean.
        """
        result = deepcopy(self)._device(stations, first)
        heard = {n: rows for n, rows in stations.items() if rows.number[-1:].ge(first).any()}
        for station, all_rows in heard.items():
            later = result._without_device(all_rows)
            for part in later.number[later.number >= first].split(TOGETHER):
                told = later[(later.number <= part[-1]) & (later.number >= result.begun[station])]
                result = result._advance(station, told, len(part), extent, rows)
            if (turn := result._standing(station)) is not None:
                alarms, world = list(result.alarms), later[later.number >= result.begun[station]]
                if (world.number < first).sum() < NAMED:
                    alarms[turn] = _named(alarms[turn], world, extent)
                result = replace(result, alarms=tuple(alarms))
        return result

    def of_now(self, station: int, rows: LaterRows) -> LaterRows:
        """Return a station's rows since the update in which its last change began."""
        now = rows.batch[rows.number >= self.begun[station]]
        turn = self._standing(station)
        # What more rows make smaller than a change was none.
        small = turn is not None and abs(self.alarms[turn].change_db) < UNUSUAL
        return rows if small or not len(now) else rows[rows.batch >= now.min()]

    def _standing(self, station: int) -> int | None:
        """Number of the alarm that stands for a station; None: it is as the map says."""
        own = [turn for turn, alarm in enumerate(self.alarms) if alarm.station == station]
        return own[-1] if own and self.alarms[own[-1]].kind != RETURNED else None

    def _device(self, stations: Mapping[int, LaterRows], first: int) -> Watch:
        """The state with an alarm where all stations' new rows miss what they did not before."""
        new = [rows for rows in (s[s.number >= first] for s in stations.values()) if len(rows)]
        before = [alarm.change_db for alarm in self.alarms if alarm.station < 0]
        offset = common_offset(new)
        if abs(offset - (before or [0.0])[-1]) < UNUSUAL:
            return self
        last = max(int(rows.number[-1]) for rows in new)
        places = torch.cat([rows.places for rows in new])
        where = _middle(places, torch.ones(len(places)).double())
        return replace(self, alarms=(*self.alarms, Alarm(-1, "device", first, last, offset, where)))

    def _without_device(self, rows: LaterRows) -> LaterRows:
        """Rows less what all stations missed since."""
        offset = torch.zeros_like(rows.missed)
        for alarm in self.alarms:
            if alarm.station < 0:
                offset[rows.number >= alarm.since] = alarm.change_db
        return replace(rows, missed=rows.missed - offset)

    def _advance(
        self, station: int, world: LaterRows, count: int, extent: float, rows: float
    ) -> Watch:
        """The state after the last `count` rows of a world."""
        before, new = world[:-count], world[-count:]
        run = world[world.number >= self.since[station]]
        near = _nearest(before, new), _nearest(run[:-count], new)
        parts = [near[0].join(new), near[0], near[1].join(new), near[1]]
        likely = change_log_evidence([part.merge(visits=True) for part in parts], extent, 0.0)
        density = (likely + NOISY.log()[:, None]).logsumexp(1) + SHARE.log()
        # A map's world ends with a change of it, a changed one with any that its rows do not say.
        changed = self._standing(station) is not None
        stays = density[:2, SAME | changed].logsumexp(1)
        ends = density[2:, ~SAME | changed].logsumexp(1)
        ratio = float(ends[0] - ends[1] - stays[0] + stays[1])
        self.detector[station] = np.logaddexp(self.detector[station], math.log(len(new))) + ratio
        self.total[station] += ratio
        if self.total[station] < UNLIKELY:
            self.since[station], self.total[station] = int(new.number[-1]) + 1, 0.0
        if self.detector[station] < math.log(rows) * (AGAIN if changed else 1):
            return self
        # It began where what follows is told better so than by what came before.
        old = _told(world[: -len(run) if changed else 0], run, extent)
        gain = (run.missed - old).square() - (run.missed - _told(run, run, extent)).square()
        run = run[int(gain.flip(0).cumsum(0).flip(0).argmax()) :]
        noted = Alarm(station, "", int(run.number[0]), int(new.number[-1]), 0.0, (0.0, 0.0))
        noted = _named(noted, run, extent)
        # What is too small for a change may still grow.
        if abs(noted.change_db) < UNUSUAL and not changed:
            return self
        if abs(noted.change_db) < UNUSUAL / 2:
            noted = replace(noted, kind=RETURNED)
        self.detector[station], self.total[station] = -math.inf, 0.0
        self.begun[station], self.since[station] = noted.since, noted.at + 1
        return replace(self, alarms=(*self.alarms, noted))


def _told(rows: LaterRows, at: LaterRows, extent: float) -> Tensor:
    """Change (n,) of the map where other rows are [dB], as a station's rows say."""
    belief = learn_changes({0: rows}, extent, looked=NAMED)
    return correct(belief, 0, rows, at.places, at.level, at.doubt).mean - at.level


def _nearest(rows: LaterRows, new: LaterRows) -> LaterRows:
    """The rows that are nearest to new ones, at most `LOOKED`."""
    distance = torch.cdist(rows.places, new.places).amin(1)
    return rows[distance.argsort()[:LOOKED].sort().values]


def _named(alarm: Alarm, rows: LaterRows, extent: float) -> Alarm:
    """An alarm as a station's rows since tell."""
    kind, change, share = main_effect(rows, extent)
    kind = "gone" if rows.silent.double().mean() > SILENT else kind
    where = _middle(rows.merge().places, share)
    return replace(alarm, kind=kind, change_db=change, place=where)


def _middle(places: Tensor, share: Tensor) -> tuple[float, float]:
    """Middle of places (n, 3) or (n, 6), of which shares (n,) count."""
    x, y = np.average(horizontal(first_end(places.numpy())), 0, share.numpy())
    return float(x), float(y)

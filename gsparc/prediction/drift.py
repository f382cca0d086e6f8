"""Whether the world still is as a map says: a sequential test of each station,
of parts of the place, of all.

What a row misses, given the map and earlier rows, is independent and of a known variance while
nothing changes. For each stream of rows an e-detector sums likelihood ratios over all times of
change (the recursion of Shiryaev and Roberts; J. Shin, A. Ramdas, A. Rinaldo, arXiv:2203.03532),
averaged over sizes. Alarms stand where one exceeds the stated number of rows over the stream's
share, so that without change the mean number of rows to an alarm
of any stream is no less than stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.processes.changes import COMMON, KINDS, LOOKED, SHARE, LaterRows, evidence
from gsparc.processes.innovations import innovations
from gsparc.processes.places import first_end, horizontal
from gsparc.processes.stored import Stored

ROWS = 10_000  # readings to a false alarm, at least, in the mean
SIZES = np.array([-4.0, -2.0, -1.0, -0.5, 0.5, 1.0, 2.0, 4.0])  # of changes [deviations]
CLIP = 4.0  # deviations that count of a row: a single outlier raises no alarm
MIXED = 0.5  # share of rows that a change is sought in: of a local one not all miss
SIDES = 4  # cells along each side of the place
# Evidence that all stations miss alike, from which on an alarm of one is called theirs
AS_ALL = 20.0
DEVICE = 2  # of KINDS: the offset that is expected after an alarm of all stations
LOUD = 2.0  # deviations of a row that lies in a local change
SPREAD = 3  # cells that rows must be of to tell an offset from a local change
SILENT = 0.5  # share of rows since a change in which a station is not heard any more: it is gone
MIXING = 1e6  # [m] between updates, further than any place is away
RETURNED = "returned"  # the kind of an alarm with which a station is as the map says again
ROW = [(n, int) for n in ("number", "station", "cell")] + [
    (n, float) for n in ("surprise", "back", "place")
]


@dataclass(frozen=True)
class Alarm(Stored):
    """A change that was noticed.

    Attributes:
        station: its number; -1: all alike, as of another device.
        kind: `device`, `offset`, `local`, `moved` or `gone`; `returned`: as the map says again.
        since, at: numbers of the rows it seems to have begun with, and that raised the alarm.
        change_db: mean that was missed since [dB].
        place: (2,) middle of the part of the place, local [m]; of other kinds the middle of the
            rows since.
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
        low, side: corner (2,) and side (2,) of cells [m].
        detector: (T + T cells + 1 + T, sizes) logarithms of detectors: of stations, of their cells,
            of all, of what changed at a station being as the map says again.
        total: the same, sums of log ratios since these were last below 0 (E. S. Page, Biometrika 41
            (1954)).
        since: the same, number of the row with which that sum began: the change is dated to it.
        kind: (T,) of the change that is expected since the last alarm, see
            `gsparc.processes.changes.KINDS`.
        begun: (T,) number of the first row that counts; what came before is of another world.
        alarms: all.
    """

    low: np.ndarray
    side: np.ndarray
    detector: np.ndarray
    total: np.ndarray
    since: np.ndarray
    kind: np.ndarray
    begun: np.ndarray
    alarms: tuple[Alarm, ...] = ()

    @classmethod
    def from_site(cls, site: Site) -> Watch:
        """Return one that has seen nothing."""
        box, none = site.moving_box[:, :2], np.zeros((0, len(SIZES)))
        kinds, begun = np.zeros((2, len(site.every_station)), np.int64)
        side = np.maximum(np.ptp(box, axis=0), 1e-3) / SIDES
        return cls(box[0], side, none, none, none.astype(np.int64), kinds, begun)

    def cells(self, places: Tensor) -> np.ndarray:
        """Return the number (n,) of the cell of places (n, 3) or (n, 6)."""
        at = (horizontal(first_end(places.numpy())) - self.low) // self.side
        column, row = np.clip(at, 0, SIDES - 1).astype(np.int64).T
        return row * SIDES + column

    def look(
        self, stations: Mapping[int, LaterRows], first: int, extent: float, rows: float = ROWS
    ) -> tuple[Watch, np.ndarray]:
        """Return the state after rows from number `first` on, and these rows' surprises (n,)
        [deviations].

        Args:
            stations: later rows of each, the new ones among them.
            first: number of the first new row.
            extent: of the site [m].
            rows: to a false alarm, at least, in the mean.
        """
        result, surprises, alarmed = self._with_all_streams(), [np.zeros(0)], True
        while alarmed:
            # After an alarm others are expected, of which later rows miss something else.
            table, alarmed = result._surprises(stations, first, extent), False
            last, begin = np.diff(table["place"], append=np.inf) != 0, 0
            for turn, row in enumerate(table):
                name, base = int(row["station"]), len(result.begun) + int(row["station"]) * SIDES**2
                ratio, number = _ratio(row["surprise"]), int(row["number"])
                each = {name: ratio, base + int(row["cell"]): ratio}
                # Mean over stations heard at one place
                if last[turn] and len(result.begun) >= COMMON:
                    each[result.every] = _ratio(table["surprise"][begin : turn + 1].mean())
                begin = turn + 1 if last[turn] else begin
                if result.kind[name]:
                    each[result.every + 1 + name] = row["back"]
                raised = [
                    key
                    for key, ratio_of_key in each.items()
                    if result._advance(key, number, ratio_of_key, rows)
                ]
                if raised:
                    result = result._note(row, raised[-1], stations, extent)
                    first, alarmed, table = number + 1, True, table[: turn + 1]
                    break
            surprises.append(table["surprise"])
        return result._named(stations, extent), np.concatenate(surprises)

    def _surprises(
        self, stations: Mapping[int, LaterRows], first: int, extent: float
    ) -> np.ndarray:
        """Rows from number `first` on in their order, with what each misses in deviations."""
        parts = [np.zeros(0, ROW)]
        for station, rows_of_station in stations.items():
            later = rows_of_station[rows_of_station.number >= int(self.begun[station])]
            start = int((later.number < first).sum())
            if start == len(later):
                continue
            surprise, back = innovations(later, start, extent, bool(self.kind[station]))
            part = np.zeros(len(surprise), ROW)
            part["number"], part["station"] = later.number[start:], station
            part["cell"] = self.cells(later.places[start:])
            part["surprise"], part["back"] = surprise, back
            # The same number for rows of one place and update alone.
            part["place"] = later.places[start:].sum(1) + MIXING * later.batch[start:]
            parts.append(part)
        return np.sort(np.concatenate(parts), order="number")

    @property
    def every(self) -> int:
        """Number of the stream of all stations."""
        return len(self.begun) * (1 + SIDES**2)

    def _with_all_streams(self) -> Watch:
        """A copy with the streams that one which saw nothing, or an older file's, lacks."""
        more = ((0, self.every + 1 + len(self.begun) - len(self.detector)), (0, 0))
        detector = np.pad(self.detector, more, constant_values=-np.inf)
        total, since = np.pad(self.total, more), np.pad(self.since, more)
        return replace(deepcopy(self), detector=detector, total=total, since=since)

    def _advance(self, stream: int, number: int, ratio: np.ndarray | float, rows: float) -> bool:
        """Whether a stream's detector, in place one row further, raises an alarm."""
        detector, total, count = self.detector[stream], self.total[stream], len(self.begun)
        self.since[stream, total <= 0] = number
        total[:] = np.maximum(total, 0) + ratio
        detector[:] = np.logaddexp(detector, 0) + ratio
        # A third of all alarms for each family of streams, in equal shares.
        family = (
            1
            if stream == self.every
            else count * SIDES**2
            if count <= stream < self.every
            else count
        )
        return self._evidence(stream) >= math.log(3 * family * rows)

    def _evidence(self, stream: int) -> float:
        """Logarithm of a stream's detector."""
        return float(np.logaddexp.reduce(self.detector[stream])) - math.log(len(SIZES))

    def _note(
        self, row: np.ndarray, stream: int, stations: Mapping[int, LaterRows], extent: float
    ) -> Watch:
        """The state after an alarm: a change since it was dated is from now on expected."""
        alike = self._evidence(self.every) > math.log(AS_ALL)
        stream = self.every if alike and stream < self.every else stream
        since = int(self.since[stream, self.total[stream].argmax()])
        who, number = -1 if alike else int(row["station"]), int(row["number"])
        for name in stations if who < 0 else (who,):
            begin = len(self.begun) + name * SIDES**2
            streams = [name, *range(begin, begin + SIDES**2), self.every, self.every + 1 + name]
            self.detector[streams], self.total[streams] = -np.inf, 0.0
            self.begun[name] = since
        noted = Alarm(who, RETURNED if stream > self.every else "", since, number, 0.0, (0.0, 0.0))
        # Rows from then on tell nothing of the changes before.
        earlier = self._named(
            {n: station[station.number < since] for n, station in stations.items()}, extent
        )
        return replace(earlier, alarms=(*earlier.alarms, noted))._named(stations, extent)

    def _named(self, stations: Mapping[int, LaterRows], extent: float) -> Watch:
        """The same with each station's last alarm named by rows since, more than then."""
        alarms = list(self.alarms)
        for turn in sorted({alarm.station: turn for turn, alarm in enumerate(alarms)}.values()):
            alarm, who = alarms[turn], alarms[turn].station
            names = [*stations] if who < 0 else [who]
            since = [stations[n][stations[n].number >= alarm.since] for n in names if n in stations]
            parts = [rows.spread(extent, LOOKED) for rows in since]
            group = reduce(LaterRows.join, parts, LaterRows.empty())
            if not len(group):  # these rows were forgotten
                continue
            kind = _find_kind(alarm, group, extent, len(np.unique(self.cells(group.places))))
            silent = group.silent.double().mean() > SILENT
            off = group.missed.abs() > LOUD * (group.doubt + group.noise).sqrt()
            # Of a part of the place only the rows that lie in it tell how much.
            group = group[off] if KINDS[kind].name == "local" and off.any() else group
            where = tuple(horizontal(first_end(group.places.numpy())).mean(0).tolist())
            called = "device" if who < 0 else "gone" if silent else KINDS[kind].name
            called = called if kind else RETURNED
            self.kind[names] = kind
            alarms[turn] = replace(
                alarm, kind=called, change_db=float(group.missed.mean()), place=where
            )
        return replace(self, alarms=tuple(alarms))


def _find_kind(alarm: Alarm, rows: LaterRows, extent: float, cells: int) -> int:
    """Number of the kind of change that makes rows since it likeliest,
    which lie in so many cells.
    """
    if alarm.kind == RETURNED or alarm.station < 0:
        return 0 if alarm.kind == RETURNED else DEVICE
    likely = evidence([rows], extent, 0.0)[0, 0] + SHARE.log()
    # Of few cells an offset would look alike.
    there = [kind.name == "local" or (kind.name != "none" and cells >= SPREAD) for kind in KINDS]
    return int(torch.where(torch.tensor(there), likely, -math.inf).argmax())


def _ratio(surprise: float) -> np.ndarray:
    """Log ratios of likelihoods (sizes,) of a surprise."""
    return np.log(1 - MIXED + MIXED * np.exp(SIZES * np.clip(surprise, -CLIP, CLIP) - SIZES**2 / 2))

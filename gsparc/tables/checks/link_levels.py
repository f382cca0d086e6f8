"""Levels of powers as links, one station's at one place each,
that questions of plausibility are asked of.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.distance import cdist

from gsparc.data.blocks import rows_by
from gsparc.data.schema import Measurements
from gsparc.data.selection import FROM_ROW
from gsparc.physics.decibels import to_decibels
from gsparc.processes.few_rows import evenly_spaced
from gsparc.tables.links.strongest import ALONE

# Moves of which that share lead to a place nearer than all but a tenth of the others are an order;
# of a few places, to one of the nearest; changes of place that tell, and that are looked at
ORDERED, NEARER, NEAREST = 0.8, 0.1, 8
LEAST_PLACES, SAMPLE = 20, 500
UNNAMED = "the station"  # a single one, of a file without stations


@dataclass(frozen=True)
class LinkLevels:
    """One row for every measurement, and for every place and station without one.

    Attributes:
        position: (n, 3) of the moving end, in the world [m].
        station: (n,) int64.
        level_db: (n,) [dB], NaN where there is no value.
        rows: (n,) what messages call the row of the file.
        file_row: (n,) its number from 0.
        names: (T,) of the stations, for people.
        keys: (T,) as settings take them.
        station_position: (T, 3), in the world [m]; NaN where it is not known.
        limited: stations with rows below a level of hearing that the file states, or that lists
            leave out.
        device: (n,) int64, what measured a row; None where nothing tells.
    """

    position: np.ndarray
    station: np.ndarray
    level_db: np.ndarray
    rows: list[str]
    file_row: np.ndarray
    names: list[str]
    keys: list[str]
    station_position: np.ndarray
    limited: frozenset[int] = frozenset()
    device: np.ndarray | None = None

    @cached_property
    def ordered(self) -> bool:
        """Whether rows are in an order of place: most moves lead to one of the places around.

        Where they do not, no question of the rows before and after means anything. A median step
        is no sign of it: one phone's rows may follow a way, and another's stand anyhow.
        """
        place = self.position[np.r_[True, (np.diff(self.position, axis=0) != 0).any(1)]]
        if len(place) < LEAST_PLACES:
            return True
        step = np.linalg.norm(np.diff(place, axis=0), axis=1)
        some, others = evenly_spaced(len(step), SAMPLE), evenly_spaced(len(place), SAMPLE)
        nearer = (cdist(place[some], place[others]) < step[some, None]).mean(1)
        return bool(np.quantile(nearer, ORDERED) <= max(NEARER, NEAREST / len(place)))

    def heard(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each station, and its rows (k,) with a value."""
        yield from (
            (t, rows[np.isfinite(self.level_db[rows])]) for t, rows in rows_by(self.station)
        )


def link_levels(data: Measurements, file_row: np.ndarray | None = None) -> LinkLevels | None:
    """Return levels of powers with one end that stands still; None of anything else.

    Args:
        data: the measurements.
        file_row: (S,) number of each row in its file; None: the row's own.
    """
    site = data.site
    if not site.maps_levels:
        return None
    stations, station = site.every_station, data.stations_of()
    place = np.arange(len(data)) if data.place is None else data.place
    _, first, which = np.unique(place, return_index=True, return_inverse=True)
    count = len(stations)
    with np.errstate(divide="ignore"):
        level = to_decibels(data.powers()[:, 0])
    link, called = which.reshape(-1) * count + station, data.row_names
    side = data.censored_side()
    rows = np.flatnonzero(side <= 0)
    # Lists end at their weakest, of several levels: what piles up there is no receiver's noise.
    floors = np.unique(np.stack([station, level], 1)[side > 0], axis=0)
    floor_known = "sensitivity_db" in data.provenance or len(floors) > len(np.unique(floors[:, 0]))
    limited = frozenset(floors[:, 0].astype(int).tolist() if floor_known else ())
    absent = np.zeros(0, np.int64)
    # What was not heard is known to be weak, or was said to be unknown, which `links.absent`
    # judges; a file with a station for each place, as of serving cells, has no empty cells.
    absence_stated = data.censored is not None or data.provenance.get("absent") == "unknown"
    if not absence_stated and np.mean(np.bincount(np.unique(link) // count) == 1) < ALONE:
        absent = np.setdiff1d(np.arange(len(first) * count), link)
    parts = [name.split(FROM_ROW) for name in stations.name]
    for t in [
        t for t, (name, *_) in enumerate(parts) if sum(name == other for other, *_ in parts) > 1
    ]:
        # A part of a station is not absent before its first row or after its last.
        at, visits = absent // count, which[station == t]
        within = (at > visits.min(initial=len(first))) & (at < visits.max(initial=0))
        absent = absent[(absent % count != t) | within]
    order = np.argsort(np.concatenate([rows, first[absent // count]]), kind="stable")
    of_row = np.concatenate([rows, first[absent // count]])[order]
    of_link = np.concatenate([station[rows], absent % count])[order]
    levels = np.concatenate([level[rows], np.full(len(absent), np.nan)])[order]
    of_file = [called[i].partition(", station")[0] for i in of_row]
    names, keys = ([name or UNNAMED for name in names] for names in (stations.shown, stations.name))
    number = of_row if file_row is None else file_row[of_row]
    place = data.moving[of_row] + site.origin
    positions = stations.position + site.origin
    device = None if data.device is None else data.device[of_row]
    return LinkLevels(
        place, of_link, levels, of_file, number, names, keys, positions, limited, device
    )

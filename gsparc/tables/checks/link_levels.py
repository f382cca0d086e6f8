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
from gsparc.physics.decibels import to_decibels
from gsparc.processes.few_rows import evenly_spaced

# Moves of which that share lead to a place nearer than all but a tenth of the others are an order;
# of a few places, to one of the nearest; changes of place that tell, and that are looked at
ORDERED, NEARER, NEAREST = 0.8, 0.1, 8
LEAST_PLACES, SAMPLE = 20, 500
UNNAMED = "the station"  # a single one, of a file without stations


@dataclass(frozen=True)
class LinkLevels:
    """One row for every measurement.

    Attributes:
        position: (n, 3) of the moving end, in the world [m].
        station: (n,) int64.
        level_db: (n,) [dB], NaN where there is no value.
        rows: (n,) what messages call the row of the file.
        file_row: (n,) its number from 0.
        names: (T,) of the stations, for people.
        keys: (T,) as settings take them.
        station_position: (T, 3), in the world [m]; NaN where it is not known.
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
    stations = site.every_station
    with np.errstate(divide="ignore"):
        level = to_decibels(data.powers()[:, 0])
    rows = np.flatnonzero(data.censored_side() <= 0)
    of_file = [data.row_names[i].partition(", station")[0] for i in rows]
    names, keys = ([name or UNNAMED for name in names] for names in (stations.shown, stations.name))
    number = rows if file_row is None else file_row[rows]
    place, positions = data.moving[rows] + site.origin, stations.position + site.origin
    station, device = data.stations_of()[rows], None if data.device is None else data.device[rows]
    return LinkLevels(place, station, level[rows], of_file, number, names, keys, positions, device)

"""Powers between pairs of ends as rows of stations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.models.baselines.distance_law import seek_place
from gsparc.models.target_rows import rows_of
from gsparc.processes.powers import Rows


@dataclass(frozen=True)
class LinkRows(Rows):
    """Rows of several stations; `places` (n, 6) float64 are of the moving end and of the station [m].

    Attributes:
        station: (n,) int64.
        index: (n,) int64, of the measurements.
    """

    station: np.ndarray
    index: np.ndarray

    @property
    def stations(self) -> list[int]:
        """Numbers of the stations that have rows, ascending."""
        return [int(number) for number in np.unique(self.station)]

    def of(self, number: int) -> LinkRows:
        """The rows of one station."""
        return self.at(np.flatnonzero(self.station == number))

    def thinned(self, each: int, seed: int) -> LinkRows:
        """At most so many rows of each station, at places that they share where they do.

        Rows where something was heard come first where there are too many, up to half of them.
        """
        _, place = np.unique(self.places[:, :3], axis=0, return_inverse=True)
        place = place.reshape(-1)
        rank = np.random.default_rng(seed).permutation(int(place.max()) + 1)[place]
        kept = []
        for number in self.stations:
            own = np.flatnonzero(self.station == number)
            own = own[np.argsort(rank[own], kind="stable")]
            if len(own) > each:
                loud, quiet = own[~self.silent[own]], own[self.silent[own]]
                share = max(round(each * len(loud) / len(own)), min(len(loud), each // 2))
                own = np.concatenate([loud[:share], quiet[: each - share]])
            kept.append(own)
        return self.at(np.sort(np.concatenate(kept)))


def places_of(data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Places (T, 3) float64 [m] of the stations, local, and notes; one that nobody gave is sought."""
    site, notes = data.site, []
    assert site.stations is not None and data.station is not None
    places = np.array(site.stations.position, np.float64)
    for number in np.flatnonzero(~np.isfinite(places).all(1)):
        own = rows[data.station[rows] == number]
        if len(own):
            places[number] = seek_place(rows_of(data, own))
            where = ", ".join(f"{value:.4g}" for value in places[number] + site.origin)
            name = site.stations.name[number]
            notes.append(f"the place of station {name} is not given; estimated from powers at ({where}) m")
    return places, tuple(notes)


def link_rows(data: Measurements, rows: np.ndarray, places: np.ndarray) -> LinkRows:
    """Rows (n,) of stations that stand at `places` (T, 3) [m]."""
    assert data.station is not None
    station = data.station[rows].astype(np.int64)
    seen = rows_of(data, rows)
    ends = np.concatenate([seen.places.astype(np.float64), places[station]], 1)
    return LinkRows(ends, seen.decibels, seen.silent, station, np.asarray(rows, np.int64))

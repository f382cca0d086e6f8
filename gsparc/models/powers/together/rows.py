"""Powers between pairs of ends as rows of stations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsparc.data.schema import Measurements, Site
from gsparc.models.baselines.distance_law import seek_place
from gsparc.models.censored import silent
from gsparc.models.target_rows import to_real, training_targets
from gsparc.processes.powers import Rows


@dataclass(frozen=True)
class Heard:
    """Rows of several stations.

    Attributes:
        moving: (n, 3) float64 of the end that moves [m].
        still: (n, 3) of the station [m].
        station: (n,) int64.
        decibels: (n,) powers, or levels where `silent` [dB].
        silent: (n,) bool, True where nothing was heard.
        rows: (n,) int64, of the measurements.
    """

    moving: np.ndarray
    still: np.ndarray
    station: np.ndarray
    decibels: np.ndarray
    silent: np.ndarray
    rows: np.ndarray

    def at(self, chosen: np.ndarray) -> Heard:
        """The rows `chosen`."""
        return Heard(*(part[chosen] for part in vars(self).values()))

    @property
    def stations(self) -> list[int]:
        """Numbers of the stations that have rows, ascending."""
        return [int(number) for number in np.unique(self.station)]


def places_of(data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Places (T, 3) float64 [m] of the stations, local, and notes; one that nobody gave is sought."""
    site, notes = data.site, []
    assert site.stations is not None and data.station is not None
    places = np.array(site.stations.position, np.float64)
    for number in np.flatnonzero(~np.isfinite(places).all(1)):
        own = rows[data.station[rows] == number]
        if len(own):
            decibels = _decibels(data, own)
            places[number] = seek_place(Rows(data.moving[own], decibels, silent(data, own)))
            where = ", ".join(f"{value:.4g}" for value in places[number] + site.origin)
            name = site.stations.name[number]
            notes.append(f"the place of station {name} is not given; estimated from powers at ({where}) m")
    return places, tuple(notes)


def heard_rows(data: Measurements, rows: np.ndarray, places: np.ndarray) -> Heard:
    """Rows (n,) of stations that stand at `places` (T, 3) [m]."""
    assert data.station is not None
    station = data.station[rows].astype(np.int64)
    return Heard(
        data.moving[rows].astype(np.float64), places[station], station, _decibels(data, rows),
        silent(data, rows), np.asarray(rows, np.int64),
    )  # fmt: skip


def _decibels(data: Measurements, rows: np.ndarray) -> np.ndarray:
    return to_real(training_targets(data, rows), "rssi")[:, 0].astype(np.float64)


def thinned(rows: Heard, each: int, seed: int) -> Heard:
    """At most so many rows of each station, at places that they share where they do.

    Rows where something was heard come first where there are too many, up to half of them.
    """
    _, place = np.unique(rows.moving, axis=0, return_inverse=True)
    place = place.reshape(-1)
    rank = np.random.default_rng(seed).permutation(int(place.max()) + 1)[place]
    kept = []
    for number in rows.stations:
        own = np.flatnonzero(rows.station == number)
        own = own[np.argsort(rank[own], kind="stable")]
        if len(own) > each:
            loud, quiet = own[~rows.silent[own]], own[rows.silent[own]]
            share = max(round(each * len(loud) / len(own)), min(len(loud), each // 2))
            own = np.concatenate([loud[:share], quiet[: each - share]])
        kept.append(own)
    return rows.at(np.sort(np.concatenate(kept)))


def is_together(site: Site) -> bool:
    """Whether there are several stations to learn as one."""
    return site.stations is not None and len(site.stations) > 1

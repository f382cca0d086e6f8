"""Powers between pairs of ends as rows of stations, and what stations share beside their mean law.

`P = law + b decades + c decades^2 + g(place) + r_station + noise`: the law's exponent is corrected,
and bent; g, of a moving end's place, is the same for all stations, as street and crowd are. b, c
and g are columns of unit normal weights; r is the process of a station's own (`learning.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from gsparc.base.hashes import shuffle_rows
from gsparc.data.schema import Measurements
from gsparc.models.baselines.distance_law import locate_still_end, say_estimated
from gsparc.models.target_rows import power_rows
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import first_rows, sample_place_rows
from gsparc.processes.kernel import distances
from gsparc.processes.matern import matern32
from gsparc.processes.nearest import JITTER
from gsparc.processes.places import NO_PLACES, first_end
from gsparc.processes.powers import PowerRows
from gsparc.processes.sectors import Sectors
from gsparc.processes.term import Columns
from gsparc.processes.trend import Trend

LAW_DB = 5.0  # deviation a decade from the middle, of a slope and of a bend
LEAST_WHOLE = 30  # places that leave no station out, for settings by these alone
STRETCH = 4  # places in the order of the drive that are drawn as one


@dataclass(frozen=True)
class StationRows(PowerRows):
    """Rows of several stations; `places` (n, 6)
    float64 are of the moving end and of the station [m].

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

    def select_station(self, number: int) -> StationRows:
        """Return the rows of one station."""
        return self.subset(np.flatnonzero(self.station == number))

    def share_of(self, most: int, each: int) -> int:
        """Return rows of each station of which all have `most`, at most `each` and at least one."""
        return min(each, max(most // len(self.stations), 1))

    def thin_rows(self, per_station: int, seed: int) -> StationRows:
        """Return at most so many rows of each station, at places that they share where they do.

        Rows where something was heard come first where there are too many, up to half of them.
        """
        # One order of places: stations that share places keep the same ones.
        order = shuffle_rows(seed, first_end(self.places))
        return self.subset(first_rows(order, per_station, self.station, self.silent))

    def select_complete_places(self) -> Self:
        """Return those of places that have as many rows as any, if these are enough; else all."""
        ends = np.unique(self.places, axis=0)  # a sector's are of seven numbers
        count = np.unique(first_end(ends), axis=0, return_counts=True)[1]
        whole = count == count.max()
        enough = whole.sum() >= LEAST_WHOLE
        return self.subset(np.flatnonzero(whole[self._place_numbers])) if enough else self

    def draw_stretches(self, limit: int, seed: int) -> Self:
        """Draw at most so many, all that there are of places that follow each other
        in short stretches.

        To take some of the rows of a place would tell of stronger or weaker ones than there are.
        """
        place = self._place_numbers
        first = np.full(int(place.max()) + 1, len(self.index))
        np.minimum.at(first, place, self.index)
        # Places of a site in the order of measuring; the ones that begin stretches by content.
        order = np.argsort(first)
        at = first_end(self.places)[np.unique(place, return_index=True)[1]]
        turn = np.argsort(shuffle_rows(seed, at))[order]
        begun = np.pad(turn, (STRETCH - 1, 0), constant_values=len(turn))
        stretch = np.empty_like(turn)
        stretch[order] = sliding_window_view(begun, STRETCH).min(1)
        return self.subset(np.sort(np.argsort(stretch[place], kind="stable")[:limit]))

    @property
    def _place_numbers(self) -> np.ndarray:
        """Numbers (n,) of the places that the moving end was at."""
        return np.unique(first_end(self.places), axis=0, return_inverse=True)[1].reshape(-1)


def places_and_notes(data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return places (T, 3) float64 [m] of the stations, local, and notes;
    one that nobody gave is sought.
    """
    site, notes = data.site, []
    places = np.array(site.every_station.position, np.float64)
    for number in np.flatnonzero(~np.isfinite(places).all(1)):
        station_rows = rows[data.stations_of(rows) == number]
        if len(station_rows):
            places[number] = locate_still_end(power_rows(data, station_rows))
            text = say_estimated(places[number] + site.origin)
            notes.append(f"the place of station {site.every_station.shown[number]} {text}")
    return places, tuple(notes)


def rows_of_stations(data: Measurements, rows: np.ndarray, places: np.ndarray) -> StationRows:
    """Return rows (n,) of stations that stand at `places` (T, 3) [m]."""
    station = data.stations_of(rows)
    seen = power_rows(data, rows)
    ends = np.concatenate([seen.places.astype(np.float64), places[station]], 1)
    return StationRows(ends, seen.decibels, seen.side, station, np.asarray(rows, np.int64))


@dataclass(frozen=True)
class SharedTerms(Columns):
    """Shared terms; tensors are float64.

    Attributes:
        trend: the mean law, with the middle of its decades.
        nearest, farthest: decades of what was heard, of the middle; beyond, the law bends no more.
        inducing: (M, 3) places that g is known at [m].
        length: of g [m].
        place_db: deviation of g; 0: there is none.
        unit: of columns [dB].
    """

    trend: Trend
    nearest: float
    farthest: float
    inducing: Tensor
    length: float
    place_db: float = 0.0
    unit: float = 1.0

    @classmethod
    def from_rows(
        cls, rows: StationRows, trend: Trend, length: float, places: int, seed: int
    ) -> SharedTerms:
        """Make terms with g of 0 dB, known at so many places of rows, drawn evenly."""
        decades = _centred_decades(trend, torch.from_numpy(rows.places))
        bare = cls(trend, float(decades.min()), float(decades.max()), NO_PLACES, length)
        return bare.set_inducing(rows, places, seed)

    def set_inducing(self, rows: StationRows, limit: int, seed: int) -> SharedTerms:
        """Return the same with g known at so many places of rows, drawn evenly."""
        ends = np.unique(first_end(rows.places), axis=0)
        return replace(self, inducing=torch.from_numpy(ends[sample_place_rows(ends, limit, seed)]))

    def columns(self, places: Tensor) -> Tensor:
        """Return (n, P) [units] at places of both ends (n, 6) [m], or of sectors (n, 7)."""
        if isinstance(self.trend, Sectors):
            return places.new_zeros(len(places), 0)  # each site has its own
        decades = _centred_decades(self.trend, places)
        inside = decades.clamp(self.nearest, self.farthest)
        # Beyond what was heard the parabola goes on as its tangent.
        bend = inside.square() + 2 * inside * (decades - inside)
        law = LAW_DB * torch.stack([decades, bend], 1)
        if not self.place_db:
            return law / self.unit
        near = matern32(distances(self.inducing, first_end(places)), self.length)
        return torch.cat([law, self.place_db * self._inducing_factor.whiten(near).T], 1) / self.unit

    @cached_property
    def _inducing_factor(self) -> Factor:
        gram = matern32(distances(self.inducing, self.inducing), self.length)
        # Places next to each other are alike to the last digit.
        gram.diagonal().add_(JITTER)
        return Factor.from_gram(gram, "raise")


def _centred_decades(trend: Trend, places: Tensor) -> Tensor:
    assert trend.law is not None
    return trend.law.decades(places) - trend.middle

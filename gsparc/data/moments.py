"""Rows of several stations that were measured at one moment, as one row of all stations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsparc.data.schema import Measurements


@dataclass(frozen=True)
class Snapshots:
    """Channels of n moments at A antennas, of all stations, and K tones.

    Attributes:
        rows: (S,) of the measurements.
        moment: (S,) int64, which moment a row is of.
        antenna: (S,) int64, the first antenna of a row's station.
        stations: (T,) int64 numbers of the stations that antennas are of, one after the other.
        places: (n, D) [m] of what moves.
        values: (n, A, K) complex128, 0 where nothing was measured.
        tones: (K,) [Hz], relative to their mean.
        run: (n,) int64.
    """

    rows: np.ndarray
    moment: np.ndarray
    antenna: np.ndarray
    stations: np.ndarray
    places: np.ndarray
    values: np.ndarray
    tones: np.ndarray
    run: np.ndarray

    @classmethod
    def from_rows(cls, data: Measurements, rows: np.ndarray) -> Snapshots:
        """Arrange rows (S,): the i-th visit of each station to a place is one moment."""
        station = data.stations_of(rows)
        moment = number_moments(data, rows)
        _, first = np.unique(moment, return_index=True)
        target = np.asarray(data.target[rows])
        if data.mask is not None:
            target = np.where(data.mask[rows], target, 0)
        names, column = np.unique(station, return_inverse=True)
        tones = data.site.subcarriers_hz
        has_tones = tones is not None and len(tones) == target.shape[2]
        tones = np.asarray(tones, float) if has_tones else np.zeros(target.shape[2])
        run = data.runs_of(rows[first])
        empty = np.zeros((len(first), len(names) * target.shape[1], target.shape[2]), np.complex128)
        antenna, places = column * target.shape[1], data.moving[rows[first]]
        snapshots = cls(rows, moment, antenna, names, places, empty, tones - tones.mean(), run)
        return replace(snapshots, values=snapshots.arrange(target))

    def arrange(self, rows: np.ndarray) -> np.ndarray:
        """Return values (n, A, K) by moment and antenna of channels (S, a, K) of the same rows."""
        values = np.zeros_like(self.values)
        for offset in range(rows.shape[1]):
            values[self.moment, self.antenna + offset] = rows[:, offset]
        return values

    def to_rows(self, factors: np.ndarray) -> np.ndarray:
        """Return factors (S, 1, K) of rows, by those (n, K) of moments."""
        return factors[self.moment][:, None]


def number_moments(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return numbers (S,) of the moments of rows; without stations, or places in common,
    each has its own.
    """
    if data.station is None or data.place is None:
        return np.arange(len(rows))
    import pandas as pd  # here, as it takes half a second

    table = pd.DataFrame({"place": data.place[rows], "station": data.station[rows]})
    visit = table.groupby(["place", "station"]).cumcount()  # how often the station was there before
    return np.unique(np.c_[table["place"], visit], axis=0, return_inverse=True)[1].reshape(-1)

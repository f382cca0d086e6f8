"""Levels of powers by place and station, in the order of measuring: what `plausibility` looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsparc.data.schema import Measurements


@dataclass(frozen=True)
class LinkLevels:
    """One row for every measurement, and for every place and station without one.

    Attributes:
        position: (n, 3) of the moving end, in the world [m].
        station: (n,) int64.
        level_db: (n,) [dB], NaN where there is no value.
        rows: (n,) what messages call the row of the file.
        names: (T,) of the stations.
        station_position: (T, 3), in the world [m]; None where it is not known.
    """

    position: np.ndarray
    station: np.ndarray
    level_db: np.ndarray
    rows: list[str]
    names: list[str]
    station_position: np.ndarray | None


def link_levels(data: Measurements) -> LinkLevels | None:
    """Those of powers with one end that stands still; None of anything else."""
    site = data.site
    if site.kind != "rssi" or site.static_end is None:
        return None
    stations = site.stations
    station = np.zeros(len(data), np.int64) if data.station is None else data.station
    place = np.arange(len(data)) if data.place is None else data.place
    _, first, which = np.unique(place, return_index=True, return_inverse=True)
    count = 1 if stations is None else len(stations)
    with np.errstate(divide="ignore"):
        level = 10 * np.log10(data.target[:, 0].astype(np.float64) * site.target_scale)
    link, called = which.reshape(-1) * count + station, data.row_names
    rows = np.arange(len(data)) if data.censored is None else np.flatnonzero(~data.censored)
    absent = np.zeros(0, np.int64)
    # What was not heard is known to be weak; a file with a station for each place has no empty cells.
    if data.censored is None and len(first) < len(data):
        absent = np.setdiff1d(np.arange(len(first) * count), link)
    order = np.argsort(np.concatenate([rows, first[absent // count]]), kind="stable")
    of_row = np.concatenate([rows, first[absent // count]])[order]
    of_link = np.concatenate([station[rows], absent % count])[order]
    levels = np.concatenate([level[rows], np.full(len(absent), np.nan)])[order]
    of_file = [called[i].partition(", station")[0] for i in of_row]
    known = None if site.static_position is None else site.static_position[None]
    known = known if stations is None else stations.position
    known = None if known is None else known + site.origin
    names = ["the station"] if stations is None else list(stations.name)
    return LinkLevels(data.moving[of_row] + site.origin, of_link, levels, of_file, names, known)

"""Levels of powers by place and station, in the order of measuring: what doubts look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsparc.data.doubts import as_links
from gsparc.data.schema import Measurements


@dataclass(frozen=True)
class LinkLevels:
    """One row for every place and station, whether it was heard there or not.

    Attributes:
        position: (n, 3) of the moving end, *local* [m].
        station: (n,) int64.
        level_db: (n,) [dB], NaN where there is no value.
        rows: (n,) what messages call the row of the file.
        names: (T,) of the stations.
        station_position: (T, 3), *local* [m]; None where it is not known.
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
    heard = np.ones(len(data), bool) if data.censored is None else ~data.censored
    table, which = np.full((len(first), count), np.nan), which.reshape(-1)
    table[which[heard], station[heard]] = level[heard]
    rows = [data.row_names[i].partition(", station")[0] for i in first]
    position, of_link, levels, called = as_links(data.moving[first], table, rows)
    if data.censored is not None:  # what is missing there is known to be weak
        kept = np.isfinite(levels)
        position, of_link, levels = position[kept], of_link[kept], levels[kept]
        called = [row for row, keep in zip(called, kept, strict=True) if keep]
    known = None if site.static_position is None else site.static_position[None]
    known = known if stations is None else stations.position
    names = ["the station"] if stations is None else list(stations.name)
    return LinkLevels(position, of_link, levels, called, names, known)

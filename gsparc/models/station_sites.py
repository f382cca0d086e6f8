"""A site as one of its stations sees it."""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from typing import NamedTuple

import numpy as np

from gsparc.data.ends import NOBODY
from gsparc.data.query import Query
from gsparc.data.schema import OF_STATION, Measurements, Site
from gsparc.data.splits import LEAST_ROWS, Fold
from gsparc.models.method import MethodFactory
from gsparc.models.target_rows import heard_rows

UNHEARD = NOBODY  # the copy for all that were never heard


class StationsOfFold(NamedTuple):
    """Stations (T,) bool: with training rows enough for a method,
    and with test rows but without those.
    """

    learnable: np.ndarray
    only_tested: np.ndarray


def stations_of_fold(method: MethodFactory, data: Measurements, fold: Fold) -> StationsOfFold:
    """Return which stations `method` can learn, and which it is tested on without."""
    count = len(data.site.every_station)
    # Rows where nothing was heard count for a method that learns from their level.
    rows = fold.train if method.uses_censored else heard_rows(data, fold.train)
    n_train, n_test = (
        np.bincount(data.stations_of(some), minlength=count) for some in (rows, fold.test)
    )
    return StationsOfFold(n_train >= LEAST_ROWS, (n_test > 0) & (n_train < LEAST_ROWS))


def station_site(site: Site, number: int) -> Site:
    """Return the site as one station sees it; of `UNHEARD`, with both ends moving.

    Its hash is its own, so that nothing kept of one station is taken for another's.
    """
    site = replace(site, sha256=sha256(f"{site.sha256} {number}".encode()).hexdigest())
    if number == UNHEARD:
        return replace(site, stations=None, static_end=None, static_position=None)
    stations, hertz = site.every_station, float(site.carriers[number])
    rotation = site.rx_rotation if stations.rotation is None else stations.rotation[number]
    place = stations.position[number]
    array = site.array if stations.array is None else stations.array[number]
    levels = site.device_levels
    return replace(
        site,
        device_levels=None if levels is None else levels[number : number + 1],
        name=f"{site.name}{OF_STATION}{stations.shown[number]}",
        # Which way it looks is a fact of its own
        stations=None if stations.sector is None else stations.subset(np.array([number])),
        array=array,
        carrier_hz=None if np.isnan(hertz) else hertz,
        static_position=place if np.isfinite(place).all() else None,
        rx_rotation=rotation,
    )


def to_station_query(site: Site, query: Query) -> Query:
    """Rows of one station as its copy sees them: one pose where the receiver is the station,
    no number.
    """
    if site.stations is not None:
        return query
    # One pose instead of B equal ones: what depends on the receiver alone is computed once.
    still = site.static_end == "rx" and query.rx.batched
    return replace(query, rx=query.rx[0] if still else query.rx, station=None)

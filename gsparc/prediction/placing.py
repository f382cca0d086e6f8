"""From places as they were given to world coordinates of a model,
and which station each row is about.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.base.errors import DataError
from gsparc.base.instantiate import suggest_or_list
from gsparc.data.assemble import FARTHEST
from gsparc.data.schema import ENDS, End, Site
from gsparc.data.station_names import all_names, find_station
from gsparc.prediction.query import usual_heights
from gsparc.tables.query_places import QueryPlaces

# Of the largest side of the box of training places: what lies farther out is far outside
MARGIN = 0.1
SPECK = 1e-3  # of that side: in degrees a site is 1e-5 as wide as in metres, in kilometres 1e-3


def fill_heights(queries: QueryPlaces, site: Site) -> QueryPlaces:
    """Put places without a height at the one at which that end was measured, with a note.

    Raises:
        DataError: it was measured at several heights, or the model does not say at which.
    """
    ends, notes = dict(queries.ends), list(queries.notes)
    heights = usual_heights(site)
    stood = site.every_station.position[:, 2] if site.stations is not None else np.zeros(0)
    if len(np.unique(stood)) == 1:
        heights[site.still_end] = round(float(stood[0] + site.origin[2]), 6)
    for end, where in queries.ends.items():
        if where.height is not None:
            continue
        if end not in heights:
            low, high = site.moving_box[:, 2::3][:, -1 if end == "rx" else 0] + site.origin[2]
            several = f"the {ENDS[end]} was measured at heights from {low:g} to {high:g} m"
            say = (
                f"say columns.{'' if len(ends) == 1 else end + '_'}height=NUMBER, or give it "
                "in the file"
            )
            raise DataError(f"{queries.source}: no height, and {several}; {say}")
        height = np.full(len(queries), heights[end])
        ends[end] = replace(where, height=height)
        notes.append(
            f"no height of the {ENDS[end]}: taken as {heights[end]:g} m, as when it was measured"
        )
    return replace(queries, ends=ends, notes=tuple(notes))


def to_world(queries: QueryPlaces, site: Site) -> dict[End, np.ndarray]:
    """Return world positions (n, 3) [m] by end of places with heights.

    Raises:
        DataError: degrees where the model knows none, or a place that no measurement in metres can
            have.
    """
    origin, world = site.georeference, dict[End, np.ndarray]()
    for end, where in queries.ends.items():
        if where.degrees and origin is None:
            fault = (
                f"places in degrees, but {site.name} was measured in metres about an unknown origin"
            )
            raise DataError(f"{queries.source}: {fault}; give x, y and z [m]")
        across = where.across
        if where.degrees and origin is not None:
            across = origin.from_degrees(*across.T)
        assert where.height is not None
        world[end] = np.column_stack([across, where.height])
        wrong = np.flatnonzero((np.abs(world[end]) > FARTHEST).any(axis=1))
        if len(wrong):
            place = ", ".join(f"{value:g}" for value in where.all()[wrong[0]])
            fault = (
                f"({place}) is more than {FARTHEST / 1e3:.0f} km from the origin; expected metres"
            )
            raise DataError(f"{queries.source}, {queries.rows[wrong[0]]}: {fault}, or degrees")
    return world


def far_outside_and_margin(world: dict[End, np.ndarray], site: Site) -> tuple[np.ndarray, float]:
    """Tell which places (n,) bool lie farther outside the training places' box than a margin,
    and that [m].

    >>> places = {"rx": np.array([[4.0, 4.0, 1.5], [400.0, 4.0, 1.5]])}
    >>> far, margin = far_outside_and_margin(places, predictor.site)
    >>> far, 0 < margin < 1  # a tenth of the longer side
    (array([False,  True]), True)
    """
    place, (low, high) = site.local_places(world), site.moving_box
    # Of the longest side: a corridor is so narrow that every place beside it would be far outside.
    margin = MARGIN * float((high - low).max())
    return ((place < low - margin) | (place > high + margin)).any(axis=1), margin


def say_height_error(world: dict[End, np.ndarray], site: Site, far: np.ndarray) -> str:
    """Say that places which are `far` (n,) outside are so only in height; empty: they are not."""
    low, high = site.moving_box[:, 2::3] + site.origin[2]
    heights = np.column_stack([world[end][:, 2] for end in site.moving_ends])
    # With heights as measured: if these places are inside, height alone is what was wrong.
    inside = np.clip(heights, low, high)
    flat = {
        end: np.column_stack([world[end][:, :2], inside[:, i]])
        for i, end in enumerate(site.moving_ends)
    }
    if far_outside_and_margin(flat, site)[0].any():
        return ""
    beyond = (heights - inside)[far].ravel()
    most = float(beyond[np.abs(beyond).argmax()])
    side = "above" if most > 0 else "below"
    return f", {abs(most):,.0f} m {side}, only in height: above the sea, or the ground?"


def say_tiny_extent(queries: QueryPlaces, world: dict[End, np.ndarray], site: Site) -> str | None:
    """Say that several places (n, 3) [m] lie in a speck of where was measured; None:
    they do not.
    """
    # Places that came in degrees were projected, and have no unit that can be mistaken.
    metres = [world[end] for end, where in queries.ends.items() if not where.degrees]
    low, high = site.moving_box
    wide = max((float(np.ptp(metre[:, :2], axis=0).max()) for metre in metres), default=0.0)
    side = float((high - low).max())
    if not 0 < wide <= SPECK * side:
        return None
    extent = f"all places lie within {wide:.2g} m of each other, those measured within {side:.3g} m"
    return f"{extent}: degrees or km as x and y?"


def rows_and_stations(
    queries: QueryPlaces, site: Site, wanted: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return row of the places and station (N,) int64 of each prediction; 0 without stations.

    Args:
        queries: a row about the station it names; where none are named, about every station.
        site: of the model.
        wanted: name or number of the only station to predict; None: all.

    Raises:
        DataError: a station that the model does not have, or no row is about `wanted`.
    """
    rows, stations = np.arange(len(queries)), site.stations
    if stations is None:
        if wanted is not None:
            raise DataError(
                f"station={wanted}: the model of {site.name} has no stations; leave it out"
            )
        return rows, np.zeros_like(rows)
    called = all_names(stations)
    only = None if wanted is None else find_station(wanted, stations)
    if wanted is not None and only is None:
        raise DataError(f"station={wanted}: no such station{suggest_or_list(wanted, called)}")
    if queries.station is None:
        # Each row about every station, those of one row side by side.
        numbers_asked = np.arange(len(stations)) if only is None else np.array([only])
        return np.repeat(rows, len(numbers_asked)), np.tile(numbers_asked, len(rows))
    # By name alone: a number is a name, or wrong.
    numbers = {name: find_station(name, stations) for name in called}
    plain = queries.station if queries.plain is None else queries.plain
    words = zip(queries.station.tolist(), plain.tolist(), strict=True)
    matches = (numbers.get(word, numbers.get(short)) for word, short in words)
    number = np.array([-1 if match is None else match for match in matches], np.int64)
    if (number < 0).any():
        row = int(np.argmax(number < 0))
        word = str(queries.station[row])
        fault = f"{word!r} is no station of the model{suggest_or_list(word, called)}"
        raise DataError(f"{queries.source}, column of stations, {queries.rows[row]}: {fault}")
    rows = rows if only is None else np.flatnonzero(number == only)
    if not len(rows):
        raise DataError(
            f"station={wanted}: no row of {queries.source} is about it; leave out one of the two"
        )
    return rows, number[rows]

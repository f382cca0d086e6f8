"""Stations by name: which is meant, and what the names of a site have in common."""

from __future__ import annotations

import re

from gsparc.data.schema import Stations


def find_station(wanted: str | int, stations: Stations) -> int | None:
    """Return which station is meant by its name, that of the list of cells,
    or both as they are shown.

    By its number, too, if no name is one.

    Returns:
        None where there is none (7 is not the eighth of the cells 33, 212, ...),
        or several are called so.
    """
    counted = not any(name.isdigit() for name in stations.name)
    numbers = [str(number) for number in range(len(stations) if counted else 0)]
    name_lists = stations.name, stations.label or (), stations.shown, numbers
    named = (
        list(names).index(str(wanted))
        for names in name_lists
        if list(names).count(str(wanted)) == 1
    )
    return next(named, None)


def site_name(name: str) -> str:
    """Return what the names of a site's stations have in common: all but the last part of one.

    >>> site_name("town-3-1"), site_name("roof")
    ('town-3', 'roof')
    """
    return re.sub(r"(.)[-_ /.:][^-_ /.:]*$", r"\1", name)


def all_names(stations: Stations) -> list[str]:
    """List all that `find_station` finds stations by, but numbers."""
    return list(dict.fromkeys([*stations.name, *(stations.label or ())]))

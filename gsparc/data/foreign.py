"""Rows that cannot belong to their station: an identity that is used again elsewhere.

Nothing falls more slowly with distance than in free space. A patch of places, apart from all others
of its station, with levels above what the strongest of these would be there, is another station's.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsparc.base.errors import Severe, list_first, name_row_ranges
from gsparc.data.schema import Measurements
from gsparc.data.spacing import number_squares, tenth_of_extent
from gsparc.physics.decibels import to_decibels

ABOVE_DB, STRONG = 6.0, 3  # above all that can be; rows of a patch that are
LEAST = 20  # other rows of a station, that tell
NEAREST_M = 10.0  # to a station, below which no distance is believed


def find_foreign_patches(
    places: np.ndarray, level_db: np.ndarray, station: np.ndarray
) -> list[np.ndarray]:
    """Return rows of each patch of one station that cannot be its own, the strongest first.

    >>> places = np.r_[np.c_[np.arange(30.0, 330), np.zeros(300)], np.c_[2e3 + np.zeros(9), :9]]
    >>> level = np.r_[-40 - 30 * np.log10(places[:300, 0]), np.full(9, -70.0)]
    >>> [len(patch) for patch in find_foreign_patches(places, level, np.zeros(2))]
    [9]

    Args:
        places: (n, 2) or more [m].
        level_db: (n,) [dB].
        station: (2,) or more, where it stands [m].
    """
    if len(places) <= LEAST or not np.isfinite(station[:2]).all():
        return []
    away = places[:, :2] - station[:2]
    decibels = level_db + 20 * np.log10(np.maximum(np.hypot(*away.T), NEAREST_M))
    # Squares that touch are one patch
    side = tenth_of_extent(places[:, :2]) or 1.0
    square = number_squares(places[:, :2] - places[:, :2].min(0), side)
    corner = np.zeros((square.max() + 1, 2))
    corner[square] = np.floor((places[:, :2] - places[:, :2].min(0)) / side)
    pairs = cKDTree(corner).query_pairs(1.5, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), (len(corner),) * 2)
    patch = connected_components(graph)[1][square]
    result = []
    for number in np.unique(patch):
        own, others = patch == number, decibels[patch != number]
        if len(others) < max(LEAST, own.sum()):
            continue
        strongest = np.sort(decibels[own])[-STRONG:]
        if len(strongest) == STRONG and strongest[0] > others.max() + ABOVE_DB:
            result.append(np.flatnonzero(own))
    return sorted(result, key=lambda rows: -float(decibels[rows].max()))


def find_foreign(data: Measurements) -> dict[int, list[np.ndarray]]:
    """Return by station the rows (n,) of each patch that cannot be its own."""
    if not data.site.maps_levels:
        return {}
    heard, stations = np.flatnonzero(data.censored_side() == 0), data.site.every_station.position
    with np.errstate(divide="ignore"):
        level, number = to_decibels(data.powers()[:, 0]), data.stations_of()
    result = dict[int, list[np.ndarray]]()
    for t in np.unique(number[heard]).tolist():
        rows = heard[(number[heard] == t) & np.isfinite(level[heard])]
        patches = find_foreign_patches(data.moving[rows], level[rows], stations[t])
        result |= {t: [rows[patch] for patch in patches]} if patches else {}
    return result


def foreign_warnings(data: Measurements) -> list[str]:
    """Say in one sentence which rows cannot belong to their stations."""
    parts, site = list[str](), data.site
    for t, patches in find_foreign(data).items():
        for rows in patches:
            middle = np.median(data.moving[rows, :2], axis=0)
            far = float(np.hypot(*(middle - site.every_station.position[t, :2])))
            names = sorted({data.row_names[i].partition(", station")[0] for i in rows}, key=_number)
            parts.append(
                f"{site.every_station.shown[t] or 'the station'}, {far:.0f} m away "
                f"({len(rows)} rows: {name_row_ranges(names, 3)})"
            )
    told = "rows are stronger than any place as far away can have them in free space"
    advice = "an identity used again elsewhere? split.leave_out=foreign leaves them out"
    return [Severe(f"{told}: {list_first(parts)}: {advice}")] if parts else []


def _number(name: str) -> int:
    last = name.rpartition(" ")[2]
    return int(last) if last.isdigit() else -1

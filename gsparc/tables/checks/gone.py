"""Stations that lists of the strongest hold up to a row and never again,
though the drive comes back.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.base.errors import Severe, list_first
from gsparc.data.schema import Measurements
from gsparc.data.selection import FROM_ROW
from gsparc.data.spacing import number_squares, usual_step
from gsparc.processes.few_rows import evenly_spaced
from gsparc.tables.links.strongest import strongest_lists

# Usual steps to lists that count as near; lists that tell how alike these are
REACH, SAMPLE = 10.0, 500
MOST = 20_000_000  # distances held at once
ABOVE_DB = 6.0  # the weakest of a list, where it should hold a station
LEAST = 12  # later lists near earlier ones that held a station
# That a station which is there stays out of all; most that one list is trusted
CHANCE, SURE = 1e-6, 0.95


def gone_warnings(data: Measurements) -> list[str]:
    """Warn of stations that no list of the strongest holds from a row on,
    though nearby earlier ones did.
    """
    lists = strongest_lists(data) if data.site.maps_levels else None
    if lists is None or data.place is None:
        return []
    heard, step = np.flatnonzero(data.censored_side() <= 0), usual_step(lists.place[:, :2])
    # As many changes of place as in `number_lists`: rows are in the order of measuring.
    if step == 0 or (np.diff(data.place[heard]) != 0).sum() > 2 * len(lists.level):
        return []
    order, stations = np.argsort(lists.first), data.site.every_station
    gone = find_gone(lists.level[order], lists.place[order, :2], REACH * step)
    # A station that a step of its level made another ends there.
    gone = {t: first for t, first in gone.items() if FROM_ROW not in stations.name[t]}
    who = [stations.shown[t] for t in gone]
    row = data.row_names[heard[lists.first[order[max(gone.values(), default=0)]]]].partition(
        ", station"
    )[0]
    finding = (
        f"{list_first(who, 12)}: in no list from {row} on, though earlier ones nearby held them"
    )
    advice = (
        "if so, remove later rows near it, or all cells of its site "
        "(dataset.stations=[names to keep])"
    )
    return [Severe(f"{finding}: off, or gone? They are learned as weak there: {advice}")] * bool(
        who
    )


def find_gone(level: np.ndarray, place: np.ndarray, reach: float) -> dict[int, int]:
    """Return the first list without a station, by stations that are in none from there on,
    but should be.

    A list should hold what the nearest earlier one holds well above its own weakest, as often as
    earlier lists do what the nearest of another pass holds.
    Lists of one square err together and count as one.

    Args:
        level: (M, T) [dB] in the order of measuring, NaN where a station is not listed.
        place: (M, 2) [m].
        reach: of lists that count as near [m].
    """
    listed, weakest, losses = np.isfinite(level), np.nanmin(level, axis=1), dict[int, int]()
    square = number_squares(place, reach)
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))]
    some = evenly_spaced(len(place), max(min(SAMPLE, MOST // len(place)), 1))
    gap = np.where(np.abs(way[some, None] - way) > 2 * reach, cdist(place[some], place), np.inf)
    other = gap.argmin(1)
    some, other = (numbers[gap.min(1) < reach] for numbers in (some, other))
    for station in np.flatnonzero(listed.sum(0) >= LEAST).tolist():
        held, first = listed[:, station], len(level) - int(listed[::-1, station].argmax())
        # Most stations end where a drive leaves them: no tree is built of these.
        if np.isin(square[first:], square[held]).sum() < LEAST:
            continue
        away, near = cKDTree(place[:first]).query(place[first:], distance_upper_bound=reach)
        late = np.flatnonzero(np.isfinite(away))
        late, near = late + first, near[late]
        late = late[level[near, station] > weakest[late] + ABOVE_DB]
        early = (some < first) & (other < first)
        early &= level[other, station] > weakest[some] + ABOVE_DB
        if min(len(late), early.sum()) >= LEAST:
            share = min(float(held[some[early]].mean()), SURE)
            if (1 - share) ** len(np.unique(square[late])) < CHANCE:
                losses[station] = first
    return losses

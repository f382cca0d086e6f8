"""Columns that nobody uses and whose values tell transmitters of one name apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, pdist

from gsparc.data.tables.heads import LEVEL_WORDS, NO_LEVEL, about, words_of

MOST_GROUPS = 12  # values of a column that may tell stations apart
LEAST_APART_DB = 6.0  # beyond what levels of one group differ by between neighbours
NEAR, LEAST_ROWS = 4, 10  # neighbours looked at; rows of pairs within and between groups
MOST_CELLS, LEAST_OWN = 4, 20  # groups that may be cells far apart, and rows of each
CANDIDATES = 12  # places of a transmitter along each axis
BETTER, FAR = 1.4, 0.4  # ratio of deviations about a law; of the site's extent, between places that fit best
LOOKED_AT = 4_000  # rows of a station
NEAREST = 0.01  # of the extent: nearer, a law of distance rises no more


def splitting(
    places: np.ndarray, level: np.ndarray, station: np.ndarray, columns: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str]]:
    """Columns whose groups have levels or places of their own, and how that shows.

    Args:
        places: (n, 2), in one unit along both axes.
        level: (n,) [dB], NaN where missing.
        station: (n,) names or numbers.
        columns: text (n,) by head, of the columns that are not used.
    """
    for head, words in columns.items():
        values, group = np.unique(words, return_inverse=True)
        if about(head) or (NO_LEVEL | LEVEL_WORDS) & set(words_of(head)) or len(values) > MOST_GROUPS:
            continue
        known, group = np.isfinite(level) & (words != ""), group.reshape(-1)
        every = [np.flatnonzero(known & (station == one)) for one in np.unique(station)]
        parts = [(places[rows], level[rows], group[rows]) for rows in every]
        apart = max(levels_apart(*part) for part in parts)
        if apart > LEAST_APART_DB:
            yield head, f"levels at equal places differ by {apart:.0f} dB between values of column {head!r}"
        elif any(places_apart(*part) for part in parts):
            yield head, f"levels fall with the distance from another place for each value of column {head!r}"


def levels_apart(places: np.ndarray, level: np.ndarray, group: np.ndarray) -> float:
    """How much more levels (n,) [dB] differ between neighbours (n, 2) of two groups than of one, median."""
    if len(level) <= NEAR:
        return 0.0
    near = cKDTree(places).query(places, k=NEAR + 1)[1][:, 1:]
    apart, same = np.abs(level[near] - level[:, None]), group[near] == group[:, None]
    few = min(same.sum(), (~same).sum()) < NEAR * LEAST_ROWS
    return 0.0 if few else float(np.median(apart[~same]) - np.median(apart[same]))


def places_apart(places: np.ndarray, level: np.ndarray, group: np.ndarray) -> bool:
    """Whether a law of distance fits far better about a place for each group, far apart, than about one."""
    groups, counts = np.unique(group, return_counts=True)
    groups = groups[counts >= LEAST_OWN]
    rows = np.flatnonzero(np.isin(group, groups))
    rows = rows[:: 1 + len(rows) // LOOKED_AT]
    extent = float(np.linalg.norm(np.ptp(places[rows], axis=0))) if len(rows) else 0.0
    if not 2 <= len(groups) <= MOST_CELLS or not extent:
        return False
    axes = np.linspace(places[rows].min(0), places[rows].max(0), CANDIDATES).T
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    decades = np.log10(cdist(places[rows], grid).clip(NEAREST * extent))

    def fitted(part: np.ndarray) -> tuple[float, np.ndarray]:
        far, values = decades[part] - decades[part].mean(0), level[rows][part] - level[rows][part].mean()
        slope = np.minimum(values @ far / np.maximum((far**2).sum(0), 1e-9), 0)
        rest = ((values[:, None] - slope * far) ** 2).sum(0)
        return float(rest.min()), grid[rest.argmin()]

    each, at = zip(*(fitted(group[rows] == one) for one in groups), strict=True)
    one = fitted(np.ones(len(rows), bool))[0]
    return bool(one > BETTER**2 * sum(each) and pdist(np.array(at)).max() > FAR * extent)

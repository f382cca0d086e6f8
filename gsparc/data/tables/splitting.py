"""Columns that nobody uses and whose values tell transmitters of one name apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.data.tables.heads import LISTS, about, words_of

MOST_GROUPS, MOST_CELLS = 12, 4  # values of a column that may tell stations apart, and cells far apart
LEAST_APART_DB = 6.0  # beyond what levels of one group differ by between neighbours
NEAR, LEAST_ROWS, LEAST_OWN = 4, 10, 20  # neighbours looked at; rows of pairs of groups; rows of a cell
CANDIDATES, LOOKED_AT = 12, 2_000  # places of a transmitter along each axis; rows of a group
BETTER, FAR = 1.7, 0.4  # ratio of deviations about a law; of the site's extent, between places that fit best
NEAREST = 0.01  # of the extent: nearer, a law of distance rises no more


def splitting(
    places: np.ndarray, level: np.ndarray, station: np.ndarray, columns: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str]]:
    """Find columns whose groups have levels or places of their own, and how that shows.

    Args:
        places: (n, 2), in one unit along both axes.
        level: (n,) [dB], NaN where missing.
        station: (n,) names or numbers.
        columns: text (n,) by head, of the columns that are not used.
    """
    for head, words in columns.items():
        values, group = np.unique(words, return_inverse=True)
        of_level = (LISTS["no_level"] | LISTS["level"]) & set(words_of(head))
        if about(head) or of_level or len(values) > MOST_GROUPS:
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
    """Return how much more levels (n,) [dB] of neighbours (n, 2) differ in two groups than in one, median."""
    if len(level) <= NEAR:
        return 0.0
    near = cKDTree(places).query(places, k=NEAR + 1)[1][:, 1:]
    apart, same = np.abs(level[near] - level[:, None]), group[near] == group[:, None]
    few = min(same.sum(), (~same).sum()) < NEAR * LEAST_ROWS
    return 0.0 if few else float(np.median(apart[~same]) - np.median(apart[same]))


def places_apart(places: np.ndarray, level: np.ndarray, group: np.ndarray) -> bool:
    """Tell whether groups of rows (n,) follow a law of distance far better from a place each than one.

    Each has a level of its own, so that a gain alone makes no second place.
    """
    groups, counts = np.unique(group, return_counts=True)
    groups = groups[counts >= LEAST_OWN]
    extent = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) else 0.0
    if not 2 <= len(groups) <= MOST_CELLS or not extent:
        return False
    grid = np.stack(np.meshgrid(*np.linspace(places.min(0), places.max(0), CANDIDATES).T), -1).reshape(-1, 2)
    sums = []
    for one in groups:
        rows = np.flatnonzero(group == one)
        rows = rows[:: 1 + len(rows) // LOOKED_AT]
        decades = np.log10(cdist(places[rows], grid).clip(NEAREST * extent))
        decades, values = decades - decades.mean(0), level[rows] - level[rows].mean()
        sums.append(((decades**2).sum(0), values @ decades, values @ values))
    for (square, product, rest), (square_, product_, rest_) in combinations(sums, 2):
        fall = np.minimum(product[:, None] + product_, 0) ** 2 / (square[:, None] + square_).clip(1e-9)
        left = rest + rest_ - fall  # for a place of each
        first, second = np.unravel_index(left.argmin(), left.shape)
        far = np.linalg.norm(grid[first] - grid[second]) > FAR * extent
        if far and np.diag(left).min() > BETTER**2 * left.min():
            return True
    return False

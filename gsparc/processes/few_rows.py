"""Few of many rows, by which settings are chosen: drawn evenly, by groups, over a site,
or every so many.
"""

from __future__ import annotations

import numpy as np

from gsparc.base.hashes import shuffle_rows

Seed = int | np.random.Generator

ENOUGH = 0.8  # of rows that cover a site, one in each cell
HALVINGS = 40  # of the side of cells, each a look at all rows


def sample_row_numbers(count: int, most: int, seed: Seed) -> np.ndarray:
    """Draw at most so many of `count` rows, sorted.

    >>> sample_row_numbers(5, most=9, seed=0)
    array([0, 1, 2, 3, 4])
    """
    return np.sort(np.random.default_rng(seed).permutation(count)[:most])


def sample_place_rows(places: np.ndarray, most: int, seed: Seed) -> np.ndarray:
    """Draw at most so many of places (n, D), sorted, see `shuffle_rows`."""
    return np.sort(shuffle_rows(seed, places)[:most])


def first_rows(order: np.ndarray, most: int, group: np.ndarray, silent: np.ndarray) -> np.ndarray:
    """Return of each group the first rows in an order, sorted;
    at least half were heard where as many were.

    >>> first_rows(np.arange(5), most=2, group=np.zeros(5), silent=np.arange(5) < 4)
    array([0, 4])

    Args:
        order: (n,) of rows.
        most: rows of each group.
        group: (n,) labels.
        silent: (n,) bool, rows where nothing was heard.
    """
    chosen = [order[:0]]
    for number in np.unique(group):
        rows = order[group[order] == number]
        loud, quiet = rows[~silent[rows]], rows[silent[rows]]
        if len(rows) > most:
            share = max(round(most * len(loud) / len(rows)), min(len(loud), most // 2))
            loud, quiet = loud[:share], quiet[: most - share]
        chosen += [loud, quiet]
    return np.sort(np.concatenate(chosen))


def evenly_spaced(count: int, most: int) -> np.ndarray:
    """Return (n,) int64, at most `most` of `count` numbers in order, evenly from first to last."""
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def covering_rows(places: np.ndarray, most: int, seed: int) -> np.ndarray:
    """Draw at most so many rows, sorted: one in each of as many cubic cells of one side,
    the rest at random.

    A vehicle that stood for an hour counts no more than a place that it drove by.
    Time is linear in n.

    >>> covering_rows(np.array([[0.0], [0.1], [0.2], [50.0], [100.0]]), most=3, seed=0).shape
    (3,)

    Args:
        places: (n, D) [m].
        most: rows, at least 1.
        seed: of what is drawn.
    """
    if len(places) <= most:
        return np.arange(len(places))
    order = shuffle_rows(seed, places)
    low, size = places.min(0), max(float(np.ptp(places, axis=0).max()), np.finfo(float).tiny)
    mixing = np.random.default_rng(0).integers(1, 2**62, places.shape[1])
    fine, coarse, first = 0.0, size * 2, order[:1]
    for _ in range(HALVINGS):
        # Bisection: the larger the cells are, the fewer rows are drawn.
        side = fine + (coarse - fine) / 2
        cells = np.floor((places[order] - low) / side).astype(np.int64)
        number = cells @ mixing  # of each cell its own, but for collisions of no weight
        result = order[np.unique(number, return_index=True)[1]]
        if len(result) <= most:
            coarse, first = side, result
        else:
            fine = side
        if len(first) >= ENOUGH * most or coarse - fine < 1e-3 * coarse:
            break
    rest = order[~np.isin(order, first)][: most - len(first)]
    return np.sort(np.concatenate([first, rest]))

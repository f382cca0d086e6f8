"""Rows drawn so that they cover the site, however unevenly it was measured."""

from __future__ import annotations

import numpy as np

ENOUGH = 0.8  # of the rows, one in each cell
HALVINGS = 40  # of the side of cells, each a look at all rows


def covering(places: np.ndarray, most: int, seed: int) -> np.ndarray:
    """At most so many rows, sorted: one drawn in each of as many cubic cells of one side, the rest at random.

    A vehicle that stood for an hour counts no more than a place that it drove by. Time is linear in n.

    Args:
        places: (n, D) [m].
        most: rows, at least 1.
        seed: of what is drawn.
    """
    if len(places) <= most:
        return np.arange(len(places))
    order = np.random.default_rng(seed).permutation(len(places))
    low, size = places.min(0), max(float(np.ptp(places, axis=0).max()), np.finfo(float).tiny)
    mixing = np.random.default_rng(0).integers(1, 2**62, places.shape[1])
    fine, coarse, first = 0.0, size * 2, order[:1]
    for _ in range(HALVINGS):
        side = fine + (coarse - fine) / 2
        cells = np.floor((places[order] - low) / side).astype(np.int64)
        number = cells @ mixing  # of each cell its own, but for collisions of no weight
        found = order[np.unique(number, return_index=True)[1]]
        if len(found) <= most:
            coarse, first = side, found
        else:
            fine = side
        if len(first) >= ENOUGH * most or coarse - fine < 1e-3 * coarse:
            break
    rest = order[~np.isin(order, first)][: most - len(first)]
    return np.sort(np.concatenate([first, rest]))

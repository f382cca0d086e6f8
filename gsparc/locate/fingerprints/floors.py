"""Where one can stand in a building: cells of every floor, finer where somebody measured."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gsparc.locate.cells import REACH, Cells, cover
from gsparc.locate.shared_kernel import STOREY_M

COARSE, MOST = 400, 8_000  # cells of the site's box to begin with, and of all floors at the end
FINEST_M = 0.4  # no level tells two places nearer than this apart
MARGIN_M = 2.0  # beyond the outermost trained places of a floor
APART = np.array([1.0, 1.0, 1e4])  # floors are no neighbours


def floors(height: np.ndarray) -> np.ndarray:
    """The median height of the floor that each of heights (n,) [m] is of."""
    order = np.argsort(height)
    number = np.empty(len(height), np.int64)
    number[order] = np.cumsum(np.diff(height[order], prepend=height.min()) > STOREY_M)
    return np.array([np.median(height[number == one]) for one in range(number.max() + 1)])[number]


def cover_floors(places: np.ndarray, around: bool, most: int = MOST) -> Cells:
    """Flat cells of the site's box on each floor, halved near trained places (n, 3) [m] up to `most` cells.

    `around`: cells far from trained places are left out.
    """
    flat = np.c_[places[:, :2], floors(places[:, 2])]
    cells = cover(np.array([flat.min(0) - MARGIN_M, flat.max(0) + MARGIN_M]) * [1, 1, 0], COARSE, False)
    height = np.repeat(np.unique(flat[:, 2]), len(cells))
    times = (len(height) // len(cells), 1)
    cells = Cells(np.c_[np.tile(cells.centre[:, :2], times), height], np.tile(cells.edge, times))
    tree = cKDTree(np.unique(flat, axis=0) * APART)
    reach = REACH * float(np.median(tree.query(tree.data, k=[min(2, tree.n)])[0]))
    while True:
        near = tree.query(cells.centre * APART)[0] <= np.maximum(reach, np.linalg.norm(cells.edge, axis=1))
        halved = near & (cells.edge.max(1) >= 2 * FINEST_M)
        if not halved.any() or len(cells) + 3 * halved.sum() > most:
            return cells.at(near) if around else cells
        cells = cells.at(~halved).with_others(cells.at(halved).halved())

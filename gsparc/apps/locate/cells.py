"""Where one can stand, as boxes that are halved where it matters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.locate.shared_kernel import STOREY_M

THIN = 0.02  # of the longest side: what is shorter is no axis
REACH = 3.0  # times the median distance between neighbouring trained places, within which one can stand
COARSE, MOST_ON_FLOORS = 400, 8_000  # cells of the site's box to begin with, and of all floors at the end
FINEST_M = 0.4  # no level tells two places nearer than this apart
MARGIN_M = 2.0  # beyond the outermost trained places of a floor
APART = np.array([1.0, 1.0, 1e4])  # floors are no neighbours


@dataclass(frozen=True)
class Cells:
    """G boxes that do not overlap.

    Attributes:
        centre: (G, 3) [m, local].
        edge: (G, 3) [m]; 0 along axes that the site does not have.
    """

    centre: np.ndarray
    edge: np.ndarray

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def size(self) -> np.ndarray:
        """Length, area or volume (G,) [m, m^2, m^3]."""
        return np.where(self.edge > 0, self.edge, 1.0).prod(1)

    def at(self, chosen: np.ndarray) -> Cells:
        """Return the cells `chosen`."""
        return Cells(self.centre[chosen], self.edge[chosen])

    def halved(self) -> Cells:
        """Each in two along every axis."""
        corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), -1).reshape(-1, 3)
        live = self.edge.max(0) > 0
        corners = np.unique(np.where(live, corners, 0.0), axis=0)
        centre = self.centre[:, None] + corners * self.edge[:, None]
        edge = np.broadcast_to(self.edge[:, None] / 2, centre.shape)
        return Cells(centre.reshape(-1, 3), edge.reshape(-1, 3))

    def with_others(self, others: Cells) -> Cells:
        """Both."""
        return Cells(np.concatenate([self.centre, others.centre]), np.concatenate([self.edge, others.edge]))

    def holding(self, place: np.ndarray) -> int:
        """Return the cell that a place (3,) is in, or that is nearest to it."""
        outside = (np.abs(self.centre - place) - self.edge / 2).clip(0) * (self.edge > 0)
        return int((outside.sum(1) + 1e-6 * np.linalg.norm(self.centre - place, axis=1)).argmin())


def cover(
    trained: np.ndarray, most: int, around: bool, open_at: Callable[[np.ndarray], np.ndarray] | None = None
) -> Cells:
    """Return about `most` equal cells of the box of trained places (n, 3) [m].

    Args:
        trained, most: places [m, local], and cells of the whole box.
        around: whether only cells near trained places are kept, as in a building one walked through.
        open_at: whether one can stand at places (m, 3) [m, local], by a floor plan.

    Raises:
        ValueError: all places are one, or one can stand nowhere.
    """
    low, extent = trained.min(0), np.ptp(trained, axis=0)
    live = extent > THIN * extent.max()
    if not live.any() or not extent.max() > 0:
        raise ValueError("locate: the model was trained at a single place")
    step = (extent[live].prod() / most) ** (1 / live.sum())
    count = np.where(live, np.maximum(np.ceil(extent / step), 1), 1).astype(int)
    edge = np.where(live, extent / count, 0.0)
    middle = np.median(trained, axis=0)
    sides = [
        low[i] + edge[i] * (np.arange(count[i]) + 0.5) if live[i] else middle[i : i + 1] for i in range(3)
    ]
    centre = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    if around:
        tree = cKDTree(np.unique(trained, axis=0))
        apart = np.median(tree.query(tree.data, k=min(2, tree.n))[0][:, -1])
        near = tree.query(centre)[0] <= max(REACH * apart, np.linalg.norm(edge))
        centre = centre[near]
    if open_at is not None:
        centre = centre[open_at(centre)]
        if not len(centre):
            raise ValueError("locate: by the plan one can stand nowhere in the box of trained places")
    return Cells(centre, np.broadcast_to(edge, centre.shape).copy())


def floors(height: np.ndarray) -> np.ndarray:
    """Return the median height of the floor that each of heights (n,) [m] is of."""
    order = np.argsort(height)
    number = np.empty(len(height), np.int64)
    number[order] = np.cumsum(np.diff(height[order], prepend=height.min()) > STOREY_M)
    return np.array([np.median(height[number == one]) for one in range(number.max() + 1)])[number]


def cover_floors(places: np.ndarray, around: bool) -> Cells:
    """Flat cells of the site's box on each floor, halved near trained places (n, 3) [m].

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
        if not halved.any() or len(cells) + 3 * halved.sum() > MOST_ON_FLOORS:
            return cells.at(near) if around else cells
        cells = cells.at(~halved).with_others(cells.at(halved).halved())

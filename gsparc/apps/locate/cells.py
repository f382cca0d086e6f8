"""Where one can stand, as boxes that are halved where it matters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

THIN = 0.02  # of the longest side: what is shorter is no axis
# Times the median distance between neighbouring trained places, within which one can stand
REACH = 3.0


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
    def volume(self) -> np.ndarray:
        """Length, area or volume (G,) [m, m^2, m^3]."""
        return np.where(self.edge > 0, self.edge, 1.0).prod(1)

    def subset(self, chosen: np.ndarray) -> Cells:
        """Return the cells `chosen`."""
        return Cells(self.centre[chosen], self.edge[chosen])

    def halve(self) -> Cells:
        """Return the cells halved along every axis."""
        live = self.edge.max(0) > 0
        corners = np.array([*product(*((-0.25, 0.25) if halved else (0.0,) for halved in live))])
        centre = self.centre[:, None] + corners * self.edge[:, None]
        edge = np.broadcast_to(self.edge[:, None] / 2, centre.shape)
        return Cells(centre.reshape(-1, 3), edge.reshape(-1, 3))

    def join(self, others: Cells) -> Cells:
        """Return these cells and others."""
        return Cells(
            np.concatenate([self.centre, others.centre]), np.concatenate([self.edge, others.edge])
        )

    def box(self) -> np.ndarray:
        """Return the corners (2, 3) [m] of all cells."""
        return np.stack(
            [(self.centre - self.edge / 2).min(0), (self.centre + self.edge / 2).max(0)]
        )

    def index_of(self, place: np.ndarray) -> int:
        """Return the cell that a place (3,) is in, or that is nearest to it."""
        outside = (np.abs(self.centre - place) - self.edge / 2).clip(0) * (self.edge > 0)
        return int((outside.sum(1) + 1e-6 * np.linalg.norm(self.centre - place, axis=1)).argmin())


def beyond_box(places: np.ndarray, box: np.ndarray, margin: np.ndarray | float = 0.0) -> np.ndarray:
    """Tell which places (n, 3) are beyond corners (2, 3), or within a margin [m], seen from above:
    (n,).
    """
    within = (places - margin > box[0]) & (places + margin < box[1])
    return ~within[:, :2][:, np.ptp(box, axis=0)[:2] > 0].all(1)


def cover_box(
    trained: np.ndarray,
    most: int,
    around: bool,
    open_at: Callable[[np.ndarray], np.ndarray] | None = None,
    beyond: float = 0,
) -> Cells:
    """Return about `most` equal cells of the box of trained places (n, 3) [m].

    Args:
        trained, most: places [m, local], and cells of the whole box.
        around: whether only cells near trained places are kept, as in a building one walked
            through.
        open_at: whether one can stand at places (m, 3) [m, local], by a floor plan.
        beyond: share of its sides that the box reaches further on each of its four sides.

    Raises:
        ValueError: all places are one, or one can stand nowhere.
    """
    low, extent = trained.min(0), np.ptp(trained, axis=0)
    low, extent = low - beyond * extent * [1, 1, 0], extent * (1 + 2 * beyond * np.array([1, 1, 0]))
    live = extent > THIN * extent.max()
    if not live.any() or not extent.max() > 0:
        raise ValueError("locate: the model was trained at a single place")
    step = (extent[live].prod() / most) ** (1 / live.sum())
    count = np.where(live, np.maximum(np.ceil(extent / step), 1), 1).astype(int)
    edge = np.where(live, extent / count, 0.0)
    middle = np.median(trained, axis=0)
    laid = [
        low[i] + edge[i] * (np.arange(count[i]) + 0.5) if live[i] else middle[[i]] for i in range(3)
    ]
    centre = np.stack(np.meshgrid(*laid, indexing="ij"), -1).reshape(-1, 3)
    if around:
        tree = cKDTree(np.unique(trained, axis=0))
        spacing = np.median(tree.query(tree.data, k=min(2, tree.n))[0][:, -1])
        centre = centre[tree.query(centre)[0] <= max(REACH * spacing, np.linalg.norm(edge))]
    if open_at is not None:
        centre = centre[open_at(centre)]
        if not len(centre):
            raise ValueError("locate: the plan has no open floor where the model was trained")
    return Cells(centre, np.broadcast_to(edge, centre.shape).copy())

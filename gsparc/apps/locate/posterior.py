"""What is known of one place: cells of a box, halved where they are likely, their masses, an area
that holds it, and how many places it may be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import logsumexp

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


MODE = 0.05  # of the mass, that a further mode has at least
BLURRED = 0.999  # of the mass: cells beyond it stay as they are
LEAST = 1e-300
# Steps up the density at most, and of a width that the last one is shorter than
SHIFTS, NEAR = 20, 0.01


def densest_cells(log_density: np.ndarray, size: np.ndarray, share: float) -> np.ndarray:
    """Return the densest cells (c,) of G that hold a share of the mass, densest first."""
    order = np.argsort(-log_density, kind="stable")
    return order[: int(np.searchsorted(np.cumsum((np.exp(log_density) * size)[order]), share)) + 1]


@dataclass(frozen=True)
class PlacePosterior:
    """Masses of the cells in which something was heard.

    Places are recorded with errors, so that the density is that of the likelihood after a
    convolution with a Gaussian: a kernel density of the cells,
    each as wide as it is itself and as the errors are.

    Attributes:
        cells: G of them.
        sharp: (G,) log mass by size of a cell by the likelihood alone, of total mass 1.
        spread: standard deviation of recorded places along each axis [m].
    """

    cells: Cells
    sharp: np.ndarray
    spread: float = 0.0

    @cached_property
    def log_density(self) -> np.ndarray:
        """(G,) log mass by size of a cell, of total mass 1."""
        if not self.spread:
            return self.sharp
        # Cells beyond the blurred ones stay sharp: blurring them all would cost G^2.
        density = self._parts(self.cells.centre)[0].sum(1) + np.where(
            self._blurred, 0.0, np.exp(self.sharp)
        )
        logarithm = np.log(density + LEAST)
        # Normalised again: densities at centres do not sum to 1, and a blur leaves the site.
        return np.asarray(logarithm - logsumexp(logarithm, b=self.cells.volume))

    @property
    def mass(self) -> np.ndarray:
        """Of each cell (G,)."""
        return np.exp(self.log_density) * self.cells.volume

    def log_density_at(self, place: np.ndarray) -> float:
        """Log density at a place (3,) itself, not of its cell."""
        cell = self.cells.index_of(place)
        if not self.spread:
            return float(self.sharp[cell])
        rest = 0.0 if self._blurred[cell] else np.exp(self.sharp[cell])
        return float(np.log(self._parts(place[None])[0].sum() + rest + LEAST))

    def mass_above(self, place: np.ndarray) -> float:
        """Return the mass of all cells more likely than a place (3,),
        and half of that of those as likely.
        """
        level, mass = self.log_density_at(place), self.mass
        # Half of those as likely, so that equal densities have a level in the middle of their mass.
        return float(
            mass[self.log_density > level].sum() + 0.5 * mass[self.log_density == level].sum()
        )

    @cached_property
    def _blurred(self) -> np.ndarray:
        """Whether a cell is one of those that hold nearly all of the mass (G,)."""
        densest = densest_cells(self.sharp, self.cells.volume, BLURRED)
        return np.isin(np.arange(len(self.cells)), densest)

    def _parts(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What b blurred cells add to the density at places (m, b),
        their centres and precisions (b, d).
        """
        live = self.cells.edge.max(0) > 0
        centre, edge = (
            part[self._blurred][:, live] for part in (self.cells.centre, self.cells.edge)
        )
        # A uniform density over an edge has the variance edge^2 / 12.
        precision = 1 / (self.spread**2 + edge**2 / 12)
        # About the middle: squares of large coordinates cancel in the product below.
        middle = centre.mean(0)
        near, offset = centre - middle, places[:, live] - middle
        squared = (
            offset**2 @ precision.T
            + (near**2 * precision).sum(1)
            - 2 * offset @ (near * precision).T
        )
        mass = np.exp(self.sharp[self._blurred]) * self.cells.volume[self._blurred]
        weight = mass * np.sqrt(precision / (2 * np.pi)).prod(1)
        return np.exp(-0.5 * squared.clip(0)) * weight, centre, precision

    def peak(self) -> np.ndarray:
        """Return the likeliest place (3,) [m, local]:
        up the density's gradient from the likeliest cell.

        By mean shift, which needs no step length (D. Comaniciu and P. Meer, "Mean shift: a robust
        approach toward feature space analysis", IEEE TPAMI 24 (2002)).
        """
        place, live = (
            self.cells.centre[self.log_density.argmax()].copy(),
            self.cells.edge.max(0) > 0,
        )
        for _ in range(SHIFTS):
            part, centre, precision = self._parts(place[None])
            pull = part[0][:, None] * precision
            before, place[live] = place[live].copy(), (pull * centre).sum(0) / (pull.sum(0) + LEAST)
            if np.abs(before - place[live]).max() * np.sqrt(precision.max()) < NEAR:
                break
        return place

    def count_modes(self, share: float) -> int:
        """Return how many connected parts the area that holds a share of the mass has."""
        some = densest_cells(self.log_density, self.cells.volume, share)
        centre, edge = self.cells.centre[some], self.cells.edge[some]
        pairs = cKDTree(centre).query_pairs(
            1.01 * np.linalg.norm(edge, axis=1).max(), output_type="ndarray"
        )
        # Cells touch where centres are no farther apart than half the sum of edges,
        # 1 % for rounding.
        pairs = pairs[
            (
                np.abs(centre[pairs[:, 0]] - centre[pairs[:, 1]])
                <= 0.51 * (edge[pairs[:, 0]] + edge[pairs[:, 1]]) + 1e-9
            ).all(1)
        ]
        graph = csr_matrix(
            (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(some), len(some))
        )
        part = connected_components(graph, directed=False)[1]
        return max(int((np.bincount(part, self.mass[some]) >= MODE).sum()), 1)

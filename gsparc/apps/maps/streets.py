"""Shortest ways between places: along the lines of a file where it holds some, else straight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Self

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

if TYPE_CHECKING:
    from shapely import LineString


@dataclass(frozen=True)
class StreetGraph:
    """Lines as a graph; where they cross or touch one may turn.

    Attributes:
        node: (V, 2) [m].
        length: (V, V) between neighbours [m], each pair once.
    """

    node: np.ndarray
    length: csr_matrix

    @classmethod
    def from_lines(cls, lines: Sequence[LineString], step_m: float) -> Self:
        """Return the graph of lines, nodes of which are no more than a step apart."""
        import shapely

        # The union cuts lines where they cross, and drops what is drawn twice.
        pieces = shapely.get_parts(shapely.segmentize(shapely.union_all(lines), step_m))
        corner, piece = shapely.get_coordinates(pieces, return_index=True)
        # To the micrometre: ends that are computed from two lines are one node.
        node, number = np.unique(corner.round(6), axis=0, return_inverse=True)
        pairs = np.stack([number.reshape(-1)[:-1], number.reshape(-1)[1:]])[
            :, piece[1:] == piece[:-1]
        ]
        lengths = np.linalg.norm(node[pairs[0]] - node[pairs[1]], axis=1)
        return cls(node, csr_matrix((lengths, pairs), shape=(len(node), len(node))))


@dataclass(frozen=True)
class Ways:
    """The shortest ways between S places.

    Attributes:
        places: (S, 2) [m].
        length: (S, S) [m].
        along: (S, S) bool, ways along streets; the others are straight.
        near: (S,) node of the streets that is next to each place.
        streets: None where all ways are straight.
    """

    places: np.ndarray
    length: np.ndarray
    along: np.ndarray
    near: np.ndarray
    streets: StreetGraph | None

    @classmethod
    def between(cls, places: np.ndarray, streets: StreetGraph | None = None) -> Self:
        """Return the ways between places (S, 2) [m].

        Two places off the streets, or on streets that do not meet, are joined by a straight line.
        """
        length = cdist(places, places)
        if streets is None:
            return cls(places, length, length < 0, np.zeros(len(places), np.int64), None)
        off, near = cKDTree(streets.node).query(places)
        lengths = [dijkstra(streets.length, directed=False, indices=node)[near] for node in near]
        ways = np.array(lengths) + off + off[:, None]
        along = ((off == 0) | (off == 0)[:, None]) & np.isfinite(ways)
        return cls(places, np.where(along, ways, length), along, near, streets)

    def path_through(self, order: np.ndarray) -> np.ndarray:
        """Return the corners (m, 2) [m] of the way through places in an order (n,)."""
        corners = [self.places[order[:1]]]
        for start, end in pairwise(order):
            if self.streets is not None and self.along[start, end]:
                before = dijkstra(
                    self.streets.length, False, self.near[start], return_predecessors=True
                )[1]
                way = [self.near[end]]
                while before[way[-1]] >= 0:
                    way.append(before[way[-1]])
                corners.append(self.streets.node[way[::-1]])
            corners.append(self.places[[end]])
        path = np.concatenate(corners)
        return path[np.append(True, np.diff(path, axis=0).any(1))] if len(path) else path


class Tour:
    """An open walk that grows place by place and is kept short.

    Args:
        length: (S, S) of the ways between places [m].
        start: the place that it starts at; None: at whichever.
        longest: metres it may have; None: any.
    """

    def __init__(self, length: np.ndarray, start: int | None, longest: float | None) -> None:
        # A place as near to all: what is before the first stop, and after the last
        nowhere = len(length)
        self.length, self.longest = np.pad(length, (0, 1)), longest
        self.walk = np.array([nowhere if start is None else start, nowhere])

    @property
    def metres(self) -> np.ndarray:
        """Return what has been walked at each stop (n,) [m]."""
        return np.cumsum(self.length[self.walk[:-2], self.walk[1:-1]])

    def reachable(self) -> np.ndarray:
        """Return which places can be added, (S,) bool."""
        if self.longest is None:
            return np.ones(len(self.length) - 1, bool)
        return self.metres[-1:].sum() + self._added().min(axis=0)[:-1] <= self.longest

    def add(self, place: int) -> None:
        """Put a place where it lengthens the walk least,
        then turn parts around where that shortens it.
        """
        self.walk = np.insert(self.walk, self._added()[:, place].argmin() + 1, place)
        while True:  # 2-opt: G. A. Croes, Oper. Res. 6 (1958)
            before, after = self.walk[:-1], self.walk[1:]
            now, length = self.length[before, after], self.length
            gain = (
                now[:, None] + now - length[np.ix_(before, before)] - length[np.ix_(after, after)]
            )
            start, end = np.unravel_index(np.triu(gain, 2).argmax(), gain.shape)
            if gain[start, end] < 1e-6 or end <= start:
                return
            self.walk[start + 1 : end + 1] = self.walk[start + 1 : end + 1][::-1].copy()

    def _added(self) -> np.ndarray:
        """What each place adds to the walk before each stop, or at its end: (stops + 1, S + 1)
        [m].
        """
        before, after = self.walk[:-1], self.walk[1:]
        return self.length[before] + self.length[after] - self.length[before, after][:, None]

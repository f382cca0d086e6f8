"""Neighbours of a place among very many, not all of the same spot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.ops.transforms import is_differentiated, to_numpy
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.kernel import distances
from gsparc.processes.stored import Stored

NEIGHBOURS = 30  # that tell of a place
WIDER = 0.5  # share of them that are of sparser sets
SPARSER = 8.0  # from one set of places to the next
FEWEST = 500  # places in the sparsest of them


@dataclass(frozen=True)
class Neighbourhood(Stored):
    """Places in sets that are ever sparser and cover the site.

    A vehicle measures every metre of one street:
    its nearest places alone are of a few metres of that street.

    >>> line = np.linspace(0, 100, 11)[:, None]  # every 10 m
    >>> Neighbourhood.from_places(line, seed=0).nearest_rows(np.array([[41.0]]), most=2).tolist()
    [[4, 5]]

    Attributes:
        places: (n, D) [m].
        level: (n,) int8, 0 of the sparsest set that covers the site; sets are disjoint.
    """

    places: np.ndarray
    level: np.ndarray

    @classmethod
    def from_places(cls, places: np.ndarray, seed: int, fewest: int = FEWEST) -> Neighbourhood:
        """Draw sets of an eighth of the places, of an eighth of these, and so on to the fewest."""
        rows, sets = np.arange(len(places)), []
        while len(rows) / SPARSER >= fewest:
            rows = rows[covering_rows(places[rows], int(len(rows) / SPARSER), seed)]
            sets.append(rows)
        level = np.full(len(places), len(sets), np.int8)
        for number, members in enumerate(sets):
            # Sets were drawn from dense to sparse, and 0 is the sparsest.
            level[members] = len(sets) - 1 - number
        return cls(places, level)

    @cached_property
    def _trees(self) -> list[tuple[np.ndarray, cKDTree]]:
        sets = [np.flatnonzero(self.level == number) for number in range(int(self.level.max()) + 1)]
        return [(members, cKDTree(self.places[members])) for members in sets]

    @cached_property
    def tree(self) -> cKDTree:
        """Of all places."""
        return cKDTree(self.places)

    def split_by_density(self, most: int) -> list[tuple[np.ndarray, int]]:
        """Return rows (m,) of each set, the densest first,
        and how many of `most` neighbours are of it.
        """
        sparser = len(self._trees) - 1
        share = int(most * WIDER) // max(sparser, 1)
        # The densest set has what the sparser ones leave, rounding included.
        counts = [most - share * sparser, *[share] * sparser]
        return [
            (members, count) for (members, _), count in zip(self._trees[::-1], counts, strict=True)
        ]

    def nearest_rows(
        self, queries: np.ndarray, excluded: np.ndarray | None = None, most: int = NEIGHBOURS
    ) -> np.ndarray:
        """Return numbers (B, k) of neighbours of queries (B, D).

        Args:
            queries: [m].
            excluded: (B,) a place for each query that is no neighbour of it; None: none. Of one
                place alone there is then no neighbour.
            most: neighbours.
        """
        result: list[np.ndarray] = []
        # One more is looked for, as the place itself is among the nearest.
        more = 0 if excluded is None else 1
        for (members, count), (_, tree) in zip(
            self.split_by_density(most), self._trees[::-1], strict=True
        ):
            row = members[tree.query(queries, k=np.arange(1, min(count + more, tree.n) + 1))[1]]
            if excluded is not None:
                # A stable sort puts the place itself last and keeps the others from near to far.
                later = np.argsort(row == excluded[:, None], axis=1, kind="stable")[
                    :, : row.shape[1] - 1
                ]
                row = np.take_along_axis(row, later, 1)
            result.append(row)
        return np.concatenate(result, 1)


def rows_with_nearest(places: np.ndarray, row: np.ndarray, most: int = NEIGHBOURS) -> np.ndarray:
    """Return rows (T, 1 + most): each of `row` (T,), then its nearest others among places (n, D).

    >>> rows_with_nearest(np.array([[0.0], [3.0], [1.0]]), np.array([0]))
    array([[0, 2, 1]])
    """
    # A row need not come first among its neighbours, as others may lie at its place.
    alike = Neighbourhood(places, np.zeros(len(places), np.int8))
    return np.c_[row, alike.nearest_rows(places[row], row, most)]


def nearest_distance(tree: cKDTree, queries: Tensor) -> Tensor:
    """Return distances (B,) [m] from queries (B, D) float64 to a tree's nearest place,
    with autograd.
    """
    distance, row = tree.query(to_numpy(queries))
    if not is_differentiated(queries):
        return torch.from_numpy(distance)
    return distances(queries[:, None], torch.from_numpy(tree.data[row])[:, None])[:, 0, 0]

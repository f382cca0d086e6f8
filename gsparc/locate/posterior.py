"""What is known of one place: masses of cells, an area that holds it, and how many places it may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsparc.locate.cells import Cells

MODE = 0.05  # of the mass, that a further mode has at least


@dataclass(frozen=True)
class Posterior:
    """Masses of the cells in which something was heard.

    Attributes:
        cells: G of them.
        log_density: (G,) log mass by size of a cell, of total mass 1.
    """

    cells: Cells
    log_density: np.ndarray

    @property
    def mass(self) -> np.ndarray:
        """Of each cell (G,)."""
        return np.exp(self.log_density) * self.cells.size

    def level(self, place: np.ndarray) -> float:
        """Mass of all cells more likely than the one that a place (3,) is in, and half of that cell's own."""
        here, mass = self.cells.holding(place), self.mass
        above = self.log_density > self.log_density[here]
        return float(mass[above].sum() + 0.5 * mass[here])

    def within(self, share: float) -> np.ndarray:
        """The most likely cells (c,) that hold a share of the mass, most likely first."""
        order = np.argsort(-self.log_density, kind="stable")
        return order[: int(np.searchsorted(np.cumsum(self.mass[order]), share)) + 1]

    def modes(self, share: float) -> list[np.ndarray]:
        """Cells of each connected part of the area that holds a share of the mass, heaviest first."""
        some = self.within(share)
        centre, edge = self.cells.centre[some], self.cells.edge[some]
        pairs = cKDTree(centre).query_pairs(1.01 * np.linalg.norm(edge, axis=1).max(), output_type="ndarray")
        touch = (np.abs(centre[pairs[:, 0]] - centre[pairs[:, 1]])
                 <= 0.51 * (edge[pairs[:, 0]] + edge[pairs[:, 1]]) + 1e-9).all(1)  # fmt: skip
        pairs = pairs[touch]
        graph = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(some), len(some)))
        part = connected_components(graph, directed=False)[1]
        mass = np.bincount(part, self.mass[some])
        order = [one for one in np.argsort(-mass) if one == mass.argmax() or mass[one] >= MODE]
        return [some[part == one] for one in order]

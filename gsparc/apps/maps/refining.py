"""Large maps from fewer predictions: cells between others are interpolated where
that is exact enough.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import maximum_filter

Ask = Callable[[np.ndarray], np.ndarray]  # flat cells (n,) -> values (n, C)
Allowed = Callable[[np.ndarray], np.ndarray]  # values (n, C) -> largest errors of these (n, C)
FIRST = 8  # cells between the first nodes
LEAST_NODES = 16  # along a side


def sample_adaptively(
    ask: Ask, inside: np.ndarray, allowed: Allowed, sure: np.ndarray, stride: int = FIRST
) -> tuple[np.ndarray, int]:
    """Return values (C, ny, nx) float32 of cells, NaN outside, and how many were asked about.

    A lattice is asked about, and then the nodes halfway between its own, those alone that lie
    beside one where interpolation missed by more than is allowed; and so on down to cells.

    Args:
        ask: values of cells.
        inside: (ny, nx) bool.
        allowed: errors of interpolation.
        sure: (ny, nx) bool, cells that are asked about in any case.
        stride: cells between nodes of the first lattice; 1 asks about every cell.
    """
    ny, nx = inside.shape
    while stride > max(min(ny, nx) // LEAST_NODES, 1):
        stride //= 2
    steps = stride >> np.arange(stride.bit_length())
    cells = np.stack(np.divmod(np.arange(ny * nx), nx), 1)
    # Nodes that no cell inside is interpolated from are not asked about.
    needed = maximum_filter(inside, 2 * stride - 1)
    values, known, doubt = np.zeros(0), np.zeros((ny, nx), bool), np.zeros((ny, nx), bool)
    for level, step in enumerate(steps.tolist()):
        rows, columns = (np.unique(np.append(np.arange(0, n, step), n - 1)) for n in (ny, nx))
        nodes = np.zeros((ny, nx), bool)
        nodes[np.ix_(rows, columns)] = True
        # The first two lattices are whole: without them nobody knows what is missed.
        beside = needed if level < 2 else maximum_filter(doubt, 2 * step + 1) | sure
        asked = nodes & beside & ~known & (inside if step == 1 else needed)
        fresh = ask(np.flatnonzero(asked))
        values = values if level else np.full((ny, nx, fresh.shape[1]), np.nan)
        doubt = np.zeros((ny, nx), bool)
        doubt[asked] = ~(np.abs(fresh - values[asked]) <= allowed(fresh)).all(axis=1)
        values[asked], known = fresh, known | asked
        if step > 1:
            nodal = RegularGridInterpolator((rows, columns), values[np.ix_(rows, columns)])
            values[~known] = nodal(cells[~known.reshape(-1)])
    values[~inside] = np.nan
    return np.moveaxis(values.astype(np.float32), -1, 0), int(known.sum())

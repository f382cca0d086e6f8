"""Large maps from fewer predictions: cells between others are interpolated where
that is exact enough.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import maximum_filter

Ask = Callable[[np.ndarray], np.ndarray]  # flat cells (n,) -> values (n, C)
LEAST_NODES = 16  # along a side


def sample_adaptively(
    ask: Ask, inside: np.ndarray, stride: int, tolerance: float
) -> tuple[np.ndarray, int]:
    """Return values (C, ny, nx) float32 of cells, NaN outside, and how many were asked about.

    A lattice is asked about, and every cell near which interpolation from it and from every second
    of its nodes differ by more than linear interpolation within the tolerance allows.

    Args:
        ask: values of cells.
        inside: (ny, nx) bool.
        stride: cells between nodes of the lattice; 1 asks about every cell.
        tolerance: largest error of interpolation that is looked for.
    """
    (ny, nx), cells = inside.shape, np.flatnonzero(inside)
    stride = min(stride, min(ny, nx) // LEAST_NODES)
    if stride < 2:
        values, count = ask(cells), len(cells)
    else:
        rows, columns = (_with_last(side, stride) for side in (ny, nx))
        nodes = ask((rows[:, None] * nx + columns).reshape(-1)).reshape(len(rows), len(columns), -1)
        few = _with_last(len(rows), 2), _with_last(len(columns), 2)
        at = np.column_stack(np.divmod(cells, nx))
        values = RegularGridInterpolator((rows, columns), nodes)(at)
        coarse = RegularGridInterpolator((rows[few[0]], columns[few[1]]), nodes[np.ix_(*few)])(at)
        # At twice the distance linear interpolation errs four times as much; NaN is doubt, too.
        wrong = np.zeros(inside.size, bool)
        wrong[cells] = ~(np.abs(values - coarse) <= 2 * tolerance).all(axis=1)
        # About a cusp the two may cross: cells as near as a node are in doubt, too.
        doubt = maximum_filter(wrong.reshape(ny, nx), 2 * stride + 1).reshape(-1)[cells]
        values[doubt] = ask(cells[doubt])
        count = len(rows) * len(columns) + int(doubt.sum())
    whole = np.full((values.shape[1], ny * nx), np.nan, np.float32)
    whole[:, cells] = values.T
    return whole.reshape(-1, ny, nx), count


def _with_last(side: int, step: int) -> np.ndarray:
    return np.unique(np.append(np.arange(0, side, step), side - 1))

"""Large maps from fewer predictions: cells between others are interpolated where that is exact enough.

A lattice of every 2^k-th cell is asked about and halved. A new point is asked about where interpolation
missed its neighbours by more than four times what is tolerated: its error falls fourfold with each halving.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter

Ask = Callable[[np.ndarray], np.ndarray]  # flat cells (n,) -> values (n, C)
WHOLE_LEVELS = 2  # of the lattice, that are asked about everywhere: the second tells how exact the first is


def refined(ask: Ask, inside: np.ndarray, stride: int, tolerance: float) -> tuple[np.ndarray, int]:
    """Values (C, ny, nx) of cells, NaN outside, and how many were asked about.

    Args:
        ask: values of cells.
        inside: (ny, nx) bool.
        stride: of the second lattice, a power of 2; 1 asks about every cell.
        tolerance: largest error of interpolation that is looked for.
    """
    ny, nx = inside.shape

    def sampled(chosen: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Values (C, r, c) float64 of the `chosen` (r, c) points of a lattice, NaN elsewhere."""
        row, column = np.nonzero(chosen)
        exact = ask(rows[row] * nx + columns[column])
        values = np.full((exact.shape[1], *chosen.shape), np.nan)
        values[:, chosen] = exact.T
        return values

    stride = min(stride, _largest(min(ny, nx)))
    if stride < 2:
        return sampled(inside, np.arange(ny), np.arange(nx)).astype(np.float32), int(inside.sum())
    step = 2 * stride
    near = maximum_filter(inside, 2 * step + 1)  # corners of every lattice square that holds a cell
    rows, columns = _nodes(ny, step), _nodes(nx, step)
    first = near[np.ix_(rows, columns)]
    values, count = sampled(first, rows, columns), int(first.sum())
    error = np.zeros(first.shape)
    level = 1
    while step > 1:
        step //= 2
        finer = _halved(rows), _halved(columns)
        guess = _between(values, rows, columns, *finer)
        bound = _between(error[None], rows, columns, *finer)[0] / 4
        new = ~(np.isin(finer[0], rows)[:, None] & np.isin(finer[1], columns)[None])
        new &= near[np.ix_(*finer)]
        if level >= WHOLE_LEVELS:
            new &= ~(bound <= tolerance)  # NaN: never tried
        rows, columns = finer
        exact = sampled(new, rows, columns)
        count += int(new.sum())
        missed = np.nan_to_num(np.abs(exact - guess), nan=np.inf).max(axis=0)
        values = np.where(new, exact, guess)
        error = maximum_filter(np.fmax(np.where(new, missed, bound), 0), 3)
        level += 1
    return np.where(inside, values, np.nan).astype(np.float32), count


def _largest(side: int) -> int:
    """The largest stride that leaves eight squares along a side."""
    return 1 << max(int(np.log2(max(side / 16, 1))), 0)


def _nodes(count: int, step: int) -> np.ndarray:
    return np.unique(np.append(np.arange(0, count, step), count - 1))


def _halved(nodes: np.ndarray) -> np.ndarray:
    return np.unique(np.concatenate([nodes, (nodes[:-1] + nodes[1:]) // 2]))


def _between(
    values: np.ndarray, rows: np.ndarray, columns: np.ndarray, to_rows: np.ndarray, to_columns: np.ndarray
) -> np.ndarray:
    """Values (C, r, c) of a lattice on a finer one, interpolated along rows, then columns."""
    for axis, (old, fine) in ((1, (rows, to_rows)), (2, (columns, to_columns))):
        at = np.clip(np.searchsorted(old, fine, side="right") - 1, 0, len(old) - 2)
        share = (fine - old[at]) / (old[at + 1] - old[at])
        share = share.reshape([-1 if k == axis else 1 for k in range(3)])
        low, high = np.take(values, at, axis=axis), np.take(values, at + 1, axis=axis)
        with np.errstate(invalid="ignore"):
            mixed = low + share * (high - low)
        # A node itself must not become NaN by a neighbour's.
        values = np.where(share == 0, low, np.where(share == 1, high, mixed))
    return values

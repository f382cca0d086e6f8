"""Predicted power over a plane: coarse at once, then finer,
in steps that others may come between.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.scene import PlacedPicture
from gsparc.prediction.levels import predict_levels
from gsparc.prediction.predictor import Predictor

FIRST = 400  # cells of the first, coarsest picture, about
STEP_S = 0.03  # of a step: what a drag waits for [s]
LEAST = 16  # cells of a step
OPACITY = 0.9
APART = 0.1  # of a plane's width, between weak places that are visited


@dataclass(frozen=True)
class Plane:
    """A picture of power over a plane, so far.

    Attributes:
        grid: the cells.
        level_db: (ny, nx), each cell with the level of the nearest that was asked about.
        stride: cells between those; 1: all were.
    """

    grid: Grid
    level_db: np.ndarray
    stride: int


def refine_plane(
    predictor: Predictor, grid: Grid, other_end: Sequence[float] | None = None
) -> Iterator[Plane | None]:
    """Return planes of ever smaller strides; None between them, about every `STEP_S`.

    `other_end` (3,) is the transmitter's world place [m] where both ends move.
    """
    level = np.full(grid.inside.shape, np.nan)
    stride = 1 << max(0, int(np.ceil(np.log2(max(np.sqrt(level.size / FIRST), 1.0)))))
    row, column = np.indices(grid.inside.shape)
    done, chunk = np.zeros(grid.inside.shape, bool), LEAST
    while stride:
        chosen = (row % stride == 0) & (column % stride == 0) & ~done & grid.inside
        cells, start = np.flatnonzero(chosen), 0
        while start < len(cells):
            begin, part = time.perf_counter(), cells[start : start + chunk]
            level.reshape(-1)[part] = predict_levels(predictor, grid.places(part), other_end)[0]
            start += len(part)
            took = time.perf_counter() - begin
            chunk = int(np.clip(chunk * STEP_S / max(took, 1e-6), max(chunk / 2, LEAST), 2 * chunk))
            yield None
        done |= chosen
        block = level[row - row % stride, column - column % stride]
        filled = np.where(np.isfinite(level), level, block)
        yield Plane(grid, np.where(grid.inside, filled, np.nan), stride)
        stride //= 2


def plane_sheet(
    name: str, grid: Grid, values: np.ndarray, legend: Legend, beneath: float = 0.0
) -> PlacedPicture:
    """Return a picture of values (ny, nx) over the cells, clear where not finite,
    `beneath` [m] lower.

    Half a dot lower, dots of the same height are seen whole.
    """
    clear = np.where(np.isfinite(values), round(255 * OPACITY), 0)[..., None].astype(np.uint8)
    image = np.concatenate([legend.to_colours(values), clear], axis=-1)
    west, east, south, north = grid.extent
    return PlacedPicture(
        name,
        np.array([west, north, grid.height - beneath]),
        np.array([east - west, 0.0, 0.0]),
        np.array([0.0, south - north, 0.0]),
        image[::-1],
    )


def weakest_place(plane: Plane, seen: Sequence[np.ndarray] = ()) -> np.ndarray | None:
    """Return the world place (3,) [m] of the cell of least power,
    `APART` of the plane's width from places `seen` (3,).

    None where there is none.
    """
    level = np.where(plane.grid.inside, plane.level_db, np.nan)
    west, east, south, north = plane.grid.extent
    for x, y, _ in seen:
        distance = np.hypot(plane.grid.x - x, plane.grid.y[:, None] - y)
        level[distance < APART * max(east - west, north - south)] = np.nan
    if not np.isfinite(level).any():
        return None
    return plane.grid.places(np.array([int(np.nanargmin(level))]))[0]

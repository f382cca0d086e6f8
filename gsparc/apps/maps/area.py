"""The cells of a map: a rectangle, polygons, or the extent of a floor plan, at one height."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

from gsparc.apps.maps.floor_plan import FloorPlan
from gsparc.apps.maps.geojson import is_drawn, read_shapes
from gsparc.base.errors import DataError
from gsparc.base.limits import POSITIVE, check_arguments, finite_array, number, or_null
from gsparc.data.assemble import FARTHEST
from gsparc.data.blocks import machine_memory
from gsparc.data.georeference import Georeference
from gsparc.data.schema import Site
from gsparc.prediction.query import usual_heights

CELLS = 20_000  # of a map whose step nobody chose, about
LEAST = 1e-4  # of a site's width, of a rectangle: in degrees a site is 1e-5 as wide as in metres
HEIGHT = 1.5  # of a hand, where nothing says another [m]
BYTES = 4 * 4  # of a cell and station: power, both ends of the interval, expected error
BYTES_MORE = 8 * 8  # of a cell besides: what pictures and files hold for a while
SHARE_OF_MEMORY = 0.5  # of the machine's, that a map may take


@dataclass(frozen=True)
class Grid:
    """Square cells, rows from south to north.

    Attributes:
        x: (nx,) centres [m], world.
        y: (ny,) likewise.
        height: of all cells [m], world.
        step: side of a cell [m].
        inside: (ny, nx) bool, cells that are asked for.
        origin: of the metres, where places came in degrees.
        indoors: (ny, nx) bool, cells in buildings that are asked for; None: none are known.
    """

    x: np.ndarray
    y: np.ndarray
    height: float
    step: float
    inside: np.ndarray
    origin: Georeference | None = None
    indoors: np.ndarray | None = None

    def places(self, cells: np.ndarray | None = None) -> np.ndarray:
        """Return world places (n, 3) [m] of `cells` (n,), numbers into the flat map.

        None: of those inside.
        """
        chosen = np.flatnonzero(self.inside) if cells is None else cells
        row, column = np.divmod(chosen, len(self.x))
        return np.column_stack([self.x[column], self.y[row], np.full(len(chosen), self.height)])

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper edge [m]."""
        half = self.step / 2
        return self.x[0] - half, self.x[-1] + half, self.y[0] - half, self.y[-1] + half


def lay_grid(
    site: Site | None,
    area: Any = None,
    height_m: float | None = None,
    step_m: float | None = None,
    plan: FloorPlan | None = None,
    stations: int = 1,
    buildings: Any = None,
    indoors: bool = False,
) -> Grid:
    """Return the cells of a map.

    Args:
        site: of the model; None before there is one: then an area or a plan says where.
        area: (x0, y0, x1, y1) [m], world; a GeoJSON file of polygons; None: the plan's extent, or
            where was measured.
        height_m: of all cells, world; None: the height at which the moving end was, the middle of
            several.
        step_m: side of a cell; None: about `CELLS` of them.
        plan: beneath the map.
        stations: layers of each cell, for what memory is needed.
        buildings: GeoJSON file of footprints, whose cells are left out.
        indoors: they are kept, and told.

    Raises:
        DataError: an area that is none, no height, a step that gives no cells, or more than memory
            holds.
    """
    check_arguments(
        locals(), step_m=or_null(POSITIVE), height_m=or_null(number(-FARTHEST, FARTHEST))
    )
    low, high, contains = _outline(site, area, plan)
    height = _height(site, height_m)
    width = high - low
    step = step_m or float(np.sqrt(max(float(width.prod()), 1e-12) / CELLS))
    count = np.ceil(width / step - 1e-9)
    needed = float(count.prod()) * (BYTES * stations + BYTES_MORE)
    if needed > SHARE_OF_MEMORY * machine_memory():
        raise DataError(
            f"step_m={step:g}: {count.prod():.3g} squares of {stations} station(s) need "
            f"{needed / 2**30:.3g} "
            f"GiB, more than half of this machine's memory; take a larger step or a smaller area"
        )
    nx, ny = (max(int(n), 1) for n in count)
    x, y = (low[i] + step * (0.5 + np.arange(n)) for i, n in enumerate((nx, ny)))
    # By rows: a million places at once take memory.
    rows = [np.column_stack([x, np.full(nx, height)]) for height in y]
    inside = np.array([np.ones(nx, bool) if contains is None else contains(row) for row in rows])
    within = np.zeros_like(inside)
    if buildings is not None:
        is_built = _drawn(site, buildings, "buildings")[1]
        within = np.array([is_built(row) for row in rows])
    inside &= indoors | ~within
    if not inside.any():
        raise DataError(
            f"area={area}: no centre of a {step:g} m cell lies in it; draw it wider or map finer"
        )
    about = None if site is None else site.georeference
    return Grid(x, y, height, step, inside, about, within & inside if indoors else None)


def _outline(
    site: Site | None, area: Any, plan: FloorPlan | None
) -> tuple[np.ndarray, np.ndarray, Any]:
    """Corners (2,) of a rectangle, and what says which places (n, 2) are inside; None: all."""
    box = None if site is None else site.moving_box
    width = 0.0 if box is None else float(np.ptp(box[:, -3:-1], axis=0).max())
    if is_drawn(area):
        (low, high), contains = _drawn(site, area, "area", width)
        return low, high, contains
    if area is not None:
        low, high = _rectangle(area)
        if (high - low).max() < LEAST * width:
            fault = (
                f"{(high - low).max():.2g} m wide, the site {width:.3g} m; a rectangle is in metres"
            )
            raise DataError(f"area={area}: {fault}, polygons of a *.geojson may be in degrees")
        return low, high, None
    if plan is not None:
        corners = plan.corners()
        return corners.min(axis=0), corners.max(axis=0), Outline(corners).contains_points
    if site is None:
        raise DataError(
            "area: nothing says where; give ckpt=FILE, area=[x0,y0,x1,y1] or plan=IMAGE"
        )
    low, high = site.moving_box[:, -3:][:, :2] + site.origin[:2]
    margin = 0.02 * max(float((high - low).max()), 1e-6)
    return low - margin, high + margin, None


def _drawn(site: Site | None, path: Any, key: str, width: float = 0.0) -> tuple[np.ndarray, Any]:
    """Corners (2, 2) of a file's polygons, and what says which places (n, 2) are inside."""
    drawn, _ = read_shapes(path, key, None if site is None else site.georeference, site_m=width)
    from shapely import contains_xy

    return np.reshape(drawn.bounds, (2, 2)), lambda places: contains_xy(drawn, places)


def _rectangle(area: Any) -> tuple[np.ndarray, np.ndarray]:
    corners = finite_array(area)
    if corners.shape != (4,):
        raise DataError(f"area={area}: expected [x0,y0,x1,y1] in metres, or a *.geojson file")
    if np.abs(corners).max() > FARTHEST:
        raise DataError(f"area={area}: {np.abs(corners).max():.3g} is no coordinate in metres")
    low, high = corners[:2], corners[2:]
    if not (high > low).all():
        raise DataError(f"area={area}: is empty; x1 must be above x0 and y1 above y0")
    return low, high


def _height(site: Site | None, height_m: float | None) -> float:
    if height_m is not None:
        return float(height_m)
    if site is None:
        return HEIGHT
    height = usual_heights(site).get(site.moving_end)
    if height is not None:
        return height
    return float(site.moving_box[:, -1].mean() + site.origin[2])

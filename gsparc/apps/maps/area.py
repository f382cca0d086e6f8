"""The cells of a map: a rectangle, polygons, or the extent of a floor plan, an image with two known
points, at one height.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from PIL import Image, UnidentifiedImageError

from gsparc.apps.maps.geojson import is_drawn, read_shapes
from gsparc.base.errors import DataError, explain_error
from gsparc.base.limits import POSITIVE, check_arguments, finite_array, number, or_null
from gsparc.data.assemble import FARTHEST
from gsparc.data.blocks import machine_memory
from gsparc.data.georeference import Georeference
from gsparc.data.schema import Site
from gsparc.prediction.query import usual_heights

LEAST_PIXELS = 2.0  # between the reference points: nearer ones tell no scale
DARK = 128  # of 255: walls are darker
LARGEST = 4000  # pixels of the longer side that are kept
SHOW = (
    "say plan_points=[[column,row,x,y],[column,row,x,y]], pixels from the upper left corner, metres"
)


@dataclass(frozen=True)
class FloorPlan:
    """An image laid on the floor.

    Attributes:
        image: (h, w, 3) uint8.
        scale: complex, metres per pixel, turned; world x + jy = `scale` (column - j row) + `shift`.
        shift: complex [m].
    """

    image: np.ndarray
    scale: complex
    shift: complex

    def corners(self) -> np.ndarray:
        """Return world places (4, 2) [m] of the corners, in turn from the upper left."""
        height, width = self.image.shape[:2]
        pixel = np.array([0, width, width - 1j * height, -1j * height])
        world = self.scale * pixel + self.shift
        return np.column_stack([world.real, world.imag])

    def is_open(self, places: np.ndarray) -> np.ndarray:
        """Return whether there is open floor (m,), a light pixel, at world places (m, 2) [m]."""
        pixel = (places[:, 0] + 1j * places[:, 1] - self.shift) / self.scale
        column, row = np.floor(pixel.real).astype(int), np.floor(-pixel.imag).astype(int)
        height, width = self.image.shape[:2]
        within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        shade = self.image[row.clip(0, height - 1), column.clip(0, width - 1)].mean(1)
        return np.asarray(within & (shade > DARK))


def read_floor_plan(path: str | Path, points: Sequence[Sequence[float]] | None) -> FloorPlan:
    """Read an image and lay it on the floor by two points.

    Args:
        path: PNG, JPEG or another image.
        points: two of (column, row, x, y): pixels from the upper left corner, world metres.

    Raises:
        DataError: no image, or points that tell no scale.
    """
    if not Path(path).is_file():
        raise DataError(f"plan={path}: no such file")
    try:
        with Image.open(path) as picture:
            shrink = max(1.0, max(picture.size) / LARGEST)
            size = tuple(max(1, round(side / shrink)) for side in picture.size)
            image = np.asarray(picture.convert("RGB").resize(size))  # type: ignore[arg-type]
    except Image.DecompressionBombError as error:
        most = (
            f"at most {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels are read, {LARGEST} a side "
            "are kept"
        )
        raise DataError(
            f"plan={path}: too large an image ({explain_error(error).partition(' exceeds')[0]}); "
            f"{most}"
        ) from None
    except (UnidentifiedImageError, OSError, ValueError):
        raise DataError(
            f"plan={path}: not an image that can be read; expected PNG or JPEG"
        ) from None
    if points is None:
        raise DataError(f"plan={path}: has no scale; {SHOW}")
    pairs = _checked(points, path)
    pixel = (pairs[:, 0] - 1j * pairs[:, 1]) / shrink
    world = pairs[:, 2] + 1j * pairs[:, 3]
    scale = (world[1] - world[0]) / (pixel[1] - pixel[0])
    return FloorPlan(image, complex(scale), complex(world[0] - scale * pixel[0]))


def _checked(points: Any, path: str | Path) -> np.ndarray:
    pairs = finite_array(points)
    if pairs.shape != (2, 4):
        raise DataError(f"plan_points={points}: two points of four numbers are needed; {SHOW}")
    if np.hypot(*(pairs[1, :2] - pairs[0, :2])) < LEAST_PIXELS:
        raise DataError(
            f"plan={path}: plan_points are one pixel, which gives no scale; take two far apart"
        )
    if (
        not 0 < np.hypot(*(pairs[1, 2:] - pairs[0, 2:])) < FARTHEST
        or np.abs(pairs[:, 2:]).max() > FARTHEST
    ):
        raise DataError(
            f"plan={path}: its two points are one place, or not in metres; take two far apart"
        )
    return pairs


def read_plan_settings(settings: Mapping[str, Any]) -> FloorPlan | None:
    """Return the floor plan that `plan` and `plan_points` of settings name;
    None where they name none.

    Raises:
        DataError: points without an image, or one that cannot be read.
    """
    if settings["plan"] is None and settings["plan_points"] is not None:
        raise DataError("plan_points: goes with an image, plan=FILE")
    return (
        None
        if settings["plan"] is None
        else read_floor_plan(settings["plan"], settings["plan_points"])
    )


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
    origin: Georeference | None = None,
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
        origin: of the metres, where there is no site.

    Raises:
        DataError: an area that is none, no height, a step that gives no cells, or more than memory
            holds.
    """
    check_arguments(
        locals(), step_m=or_null(POSITIVE), height_m=or_null(number(-FARTHEST, FARTHEST))
    )
    about = origin if site is None else site.georeference
    low, high, contains = _outline(site, area, plan, about)
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
        is_built = bounds_and_inside_test(about, buildings, "buildings")[1]
        within = np.array([is_built(row) for row in rows])
    inside &= indoors | ~within
    if not inside.any():
        raise DataError(
            f"area={area}: no centre of a {step:g} m cell lies in it; draw it wider or map finer"
        )
    return Grid(x, y, height, step, inside, about, within & inside if indoors else None)


def _outline(
    site: Site | None, area: Any, plan: FloorPlan | None, about: Georeference | None
) -> tuple[np.ndarray, np.ndarray, Any]:
    """Corners (2,) of a rectangle, and what says which places (n, 2) are inside; None: all."""
    box = None if site is None else site.moving_box
    width = 0.0 if box is None else float(np.ptp(box[:, -3:-1], axis=0).max())
    if is_drawn(area):
        (low, high), contains = bounds_and_inside_test(about, area, "area", width)
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


def bounds_and_inside_test(
    origin: Georeference | None, path: Any, key: str, width: float = 0.0
) -> tuple[np.ndarray, Any]:
    """Return corners (2, 2) of polygons, and what says which places (n, 2 or more) are inside;
    see `read_shapes`.
    """
    drawn, _ = read_shapes(path, key, origin, site_m=width)
    from shapely import contains_xy

    return np.reshape(drawn.bounds, (2, 2)), lambda places: contains_xy(drawn, places[:, :2])


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

"""What a published map claims: levels, or that a place is served, square by square."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.geojson import is_drawn, middle_of, read_shapes
from gsparc.base.errors import DataError, list_first
from gsparc.data.georeference import Georeference
from gsparc.datasets.rasters import BAND, LOCAL, read_raster
from gsparc.tables.array_checks import MOST_DB
from gsparc.tables.query_places import read_query_places

log = logging.getLogger(__name__)

MOST_SQUARES = 250_000  # of a claim: finer ones are taken together
STEPS = 200  # squares along the longer side of polygons


@dataclass(frozen=True)
class Claim:
    """Places that something is claimed of.

    Attributes:
        place: (M, 2) [m] about the origin.
        level: (M,) [dB] that is claimed; NaN of a claim of yes.
        step: side of a square [m].
        origin: of the metres; None: those of the rows.
        grid: squares of the whole claim, of which those claimed are inside.
        digest: of its file, 16 hexadecimal digits.
    """

    place: np.ndarray
    level: np.ndarray
    step: float
    origin: Georeference | None
    grid: Grid
    digest: str

    def __len__(self) -> int:
        return len(self.place)

    def coordinates(self, places: np.ndarray) -> dict[str, np.ndarray]:
        """Return columns of places (n, 2) [m], in degrees, too, where they are known."""
        columns = dict(zip(("x", "y"), places.T.round(2), strict=True))
        if self.origin is not None and len(places):
            latitude, longitude = self.origin.to_degrees(places)
            columns |= {"latitude": latitude.round(7), "longitude": longitude.round(7)}
        return columns

    def local(self, places: np.ndarray, about: Georeference | None, where: str) -> np.ndarray:
        """Return places (n, 2) [m] about another origin in the claim's metres.

        Raises:
            DataError: one of both has a place on Earth, and the other none.
        """
        if (self.origin is None) != (about is None):
            have, lack = ("rows", "claim") if self.origin is None else ("claim", "rows")
            raise DataError(
                f"{where}: the {have} have a place on Earth, the {lack} none; say the projection "
                "of the claim, claim={file: FILE, crs: 'EPSG:32617'}, and degrees of the rows"
            )
        if self.origin is None or about is None or about == self.origin:
            return places
        return self.origin.from_degrees(*about.to_degrees(places))

    def nearest(self, places: np.ndarray, reach: float) -> np.ndarray:
        """Return the number (n,) of the claimed place nearest to each of (n, 2) [m]; -1: beyond."""
        away, number = cKDTree(self.place).query(places)
        return np.where(away <= reach, number, -1)


def read_claim(
    claim: Any,
    *,
    threshold_db: float | None = None,
    station: str | None = None,
    area: Any = None,
    step_m: float | None = None,
    places: Any = None,
) -> Claim:
    """Read a claim, of the squares, or the places of a table, that it calls served.

    Args:
        claim: raster of levels, or of 1 (yes) and 0; polygons of yes, as `read_shapes` takes them;
            `{file: FILE, crs: ..., nodata: ..., legend: ...}` where a file does not state these.
        threshold_db: from which level on a place is called served; None: all levels are claimed.
        station: whose band is audited; None: that of the best server, or the only one.
        area: polygons of what is audited; None: all of it.
        step_m: side of a square [m]; None: that of the raster.
        places: table of the only places that are drawn; None: all squares.

    Raises:
        DataError: no such file, projection or band; nothing claimed; places elsewhere.
    """
    given = dict(claim) if isinstance(claim, Mapping) else {"file": claim}
    name, crs = given.pop("file", None), given.get("crs")
    if name is None or given.keys() - {"crs", "nodata", "legend"}:
        raise DataError(f"claim={claim}: takes file, crs, nodata, legend")
    path = Path(str(name))
    if not is_drawn(name) and not path.is_file():
        raise DataError(f"claim={name}: no such file; a raster or polygons are needed")
    if is_drawn(name):
        origin = None if crs == LOCAL else middle_of(name, "claim")
        at, level, step = _from_polygons(name, origin, step_m)
    else:
        origin, at, level, step = _from_raster(path, given, station)
    level = np.where(np.abs(level) <= MOST_DB, level, np.nan)
    grid, number = _lay(at, step, step_m, origin, area)
    level, yes = level[number], bool(np.isin(level[np.isfinite(level)], (0, 1)).all())
    level[~grid.inside.ravel()] = np.nan
    if yes:
        claimed = level == 1
    else:
        claimed = np.isfinite(level) & (
            level >= (-np.inf if threshold_db is None else threshold_db)
        )
    if not claimed.any():
        ends = (
            f"{np.nanmin(level):g} to {np.nanmax(level):g} dB" if np.isfinite(level).any() else ""
        )
        fault = f"its levels are {ends}" if ends and not yes else "none of its squares says yes"
        raise DataError(
            f"claim={name}: nothing in the area is claimed at threshold_dbm={threshold_db}: {fault}"
        )
    grid = replace(grid, inside=claimed.reshape(grid.inside.shape))
    content = path.read_bytes() if path.is_file() else str(name).encode()
    told = np.full(int(claimed.sum()), np.nan) if yes else level[claimed]
    digest = sha256(content).hexdigest()[:16]
    squares = Claim(grid.places()[:, :2], told, grid.step, origin, grid, digest)
    return squares if places is None else _of_places(squares, places)


def _from_polygons(
    name: Any, origin: Georeference | None, step_m: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Squares (M, 2) [m] within polygons, their ones (M,), and the side [m]."""
    from shapely import contains_xy

    drawn, _ = read_shapes(name, "claim", origin)
    low, high = np.reshape(drawn.bounds, (2, 2))
    step = step_m or float((high - low).max()) / STEPS
    x, y = (np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True))
    at = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return at, contains_xy(drawn, at) * 1.0, step


def _from_raster(
    path: Path, given: Mapping[str, Any], station: str | None
) -> tuple[Georeference | None, np.ndarray, np.ndarray, float]:
    """Origin, centres (M, 2) [m], levels (M,) [dB] and the side of a square [m]."""
    raster = read_raster(path, **given)
    if raster.crs is None and given.get("crs") is None:
        log.warning("claim=%s: states no projection; its metres are taken for the rows'", path)
    origin, names = raster.middle(path), list(raster.names)
    band = f"{BAND} {station}" if f"{BAND} {station}" in names else station or BAND
    if band not in names and (station or len(names) > 1):
        named = list_first([name or f"{k}" for k, name in enumerate(names, 1)])
        raise DataError(f"claim={path}: no band {band} among {named}; say station=NAME")
    kept = [names.index(band) if band in names else 0]
    alone = replace(raster, names=("",), units=(raster.units[kept[0]],), bands=raster.bands[kept])
    _, at, level = next(alone.levels(path, origin, key="claim"))
    if len(at) < 2:
        raise DataError(f"claim={path}: a single square is no map")
    return origin, at, level, float(np.linalg.norm(at[1] - at[0]))


def _lay(
    at: np.ndarray, step: float, step_m: float | None, origin: Georeference | None, area: Any
) -> tuple[Grid, np.ndarray]:
    """Squares of one size over a map and within the area, and the map's square (M,) of each."""
    low, high = at.min(0) - step / 2, at.max(0) + step / 2
    side = step_m or max(step, float(np.sqrt((high - low).prod() / MOST_SQUARES)))
    x, y = (np.arange(a + side / 2, b, side) for a, b in zip(low, high, strict=True))
    if not len(x) or not len(y):
        raise DataError(f"step_m={side:g}: larger than the claim, {(high - low).round()} m")
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    away, number = cKDTree(at).query(places)
    inside = away <= 0.75 * step
    if area is not None:
        from shapely import contains_xy

        drawn, _ = read_shapes(area, "area", origin, site_m=float((high - low).max()))
        inside &= contains_xy(drawn, places)
        if not inside.any():
            raise DataError(f"area={area}: no square of the claim lies in it")
    return Grid(x, y, 0.0, side, inside.reshape(len(y), len(x)), origin), number


def _of_places(squares: Claim, table: Any) -> Claim:
    """The claim of the places of a table alone."""
    told = read_query_places(table, ("rx",)).ends["rx"]
    if told.degrees != (squares.origin is not None):
        raise DataError(f"places={table}: one of claim and places is in degrees, the other not")
    at = told.across
    if squares.origin is not None:
        at = squares.origin.from_degrees(*told.across.T)
    number = squares.nearest(at, 0.75 * squares.step)
    if (number < 0).all():
        raise DataError(f"places={table}: none of them is claimed to be served")
    return replace(squares, place=at[number >= 0], level=squares.level[number[number >= 0]])

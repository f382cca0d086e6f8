"""Polygons and lines of GeoJSON (RFC 7946) or well-known text in world metres."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from pyproj import Transformer

from gsparc.base.errors import DataError, explain_error
from gsparc.base.files import write_whole
from gsparc.data.assemble import FARTHEST
from gsparc.data.georeference import Georeference, find_invalid_coordinate

if TYPE_CHECKING:
    from shapely import LineString
    from shapely.geometry.base import BaseGeometry

log = logging.getLogger(__name__)

SPECK = 1e-3  # of a site's width, that nobody draws: in degrees a site is 1e-5 as wide as in metres
UNREADABLE = OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError
SUFFIXES = (".geojson", ".json", ".wkt")
TEXT = re.compile(r"(?i)\s*(?:MULTI)?POLYGON\s*Z?\s*\(")  # well-known, in place of a file
FAR_M = 1e5  # from the site, where another reading of coordinates lies nearer: this one is wrong
LINE, POLYGON = 1, 3  # of shapely's types; larger numbers are collections


def draws_shapes(path: str | Path) -> bool:
    """Tell whether a file is GeoJSON of polygons or lines: one of points is a table."""
    if Path(path).suffix.lower() not in SUFFIXES or not Path(path).is_file():
        return False
    try:
        return any(
            geometry and geometry["type"] not in ("Point", "MultiPoint")
            for geometry in _geometries(path)
        )
    except UNREADABLE:
        return False


def is_drawn(area: Any) -> bool:
    """Tell whether an area is a file of shapes, or a polygon in well-known text."""
    is_text = isinstance(area, str | Path)
    return is_text and (Path(area).suffix.lower() in SUFFIXES or TEXT.match(str(area)) is not None)


def _geometries(path: str | Path) -> list[Any]:
    """Those of a file, undecoded; None where a feature has none."""
    text = str(path) if TEXT.match(str(path)) else Path(path).read_text(encoding="utf-8-sig")
    if TEXT.match(text):
        from shapely import from_wkt

        return [from_wkt(line).__geo_interface__ for line in text.splitlines() if line.strip()]
    content = json.loads(text)
    return [feature.get("geometry", feature) for feature in content.get("features", [content])]


def middle_of(path: str | Path, key: str) -> Georeference:
    """Return an origin in the middle of shapes in degrees.

    Raises:
        DataError: see `read_shapes`; or no degrees.
    """
    low, high = np.reshape(read_shapes(path, key, None)[0].bounds, (2, 2))
    if find_invalid_coordinate(*np.stack([low, high], 1)[::-1]) is not None:
        far = f"{max(abs(low).max(), abs(high).max()):.3g} is no degree"
        raise DataError(f"{key}={path}: {far}; say crs: local where these are the rows' metres")
    return Georeference.from_coordinates(*((low + high) / 2)[::-1])


def _in_degrees(places: np.ndarray, origin: Georeference) -> Iterator[tuple[str, np.ndarray]]:
    """Longitudes and latitudes (n, 2) of places (n, 2) by each way to write them,
    the standard's first.
    """
    yield "", places
    yield "latitude, longitude", places[:, ::-1]
    hemisphere = 326 if origin.latitude >= 0 else 327
    zone = f"EPSG:{hemisphere}{int((origin.longitude + 180) // 6) % 60 + 1:02d}"
    for name in (zone, "EPSG:3857"):  # of the site, and of maps on the web
        yield (
            f"metres of {name}",
            np.stack(Transformer.from_crs(name, 4326, always_xy=True).transform(*places.T), 1),
        )


def _to_metres(places: np.ndarray, origin: Georeference, where: str) -> np.ndarray:
    """Metres (n, 2) of places (n, 2), as the standard has them unless that is far
    and another way near.
    """
    read = {}
    for name, degrees in _in_degrees(places, origin):
        if find_invalid_coordinate(degrees[:, 1], degrees[:, 0]) is None:
            read[name] = origin.from_degrees(degrees[:, 1], degrees[:, 0])
    near = [
        name for name, metres in read.items() if np.abs(np.median(metres, axis=0)).max() < FAR_M
    ]
    if near and near[0]:
        log.warning("%s: read as %s, as the site is there", where, near[0])
    if not near and "" not in read:
        _, fault = find_invalid_coordinate(places[:, 1], places[:, 0]) or (0, "")
        raise DataError(f"{where}: {fault} (longitude first, then latitude)")
    return read[near[0] if near else ""]


def read_shapes(
    path: str | Path,
    key: str,
    origin: Georeference | None,
    lines_too: bool = False,
    site_m: float = 0.0,
) -> tuple[BaseGeometry, list[LineString]]:
    """Return the union of a file's polygons, and its lines, in metres.

    Coordinates are degrees where the model knows its place on Earth,
    or metres of the site's UTM zone.

    Args:
        path: `*.geojson`, `*.json` or `*.wkt`, or a polygon in well-known text.
        key: setting that named it, for messages.
        origin: of the model's metres; None: the file's coordinates are metres themselves.
        lines_too: whether lines will do where there are no polygons.
        site_m: width of the site [m], of which everything drawn must not be a speck: it is in
            degrees then.

    Raises:
        DataError: no file, no GeoJSON, no such shapes, one without extent, or degrees.
    """
    where = f"{key}={path}"
    if find_spec("shapely") is None:
        raise DataError(f"{where}: GeoJSON needs shapely: pip install 'gsparc[maps]'")
    import shapely
    from shapely.geometry import shape

    try:
        with np.errstate(invalid="ignore"):  # NaN is refused below
            parts = np.array(
                [shape(geometry) for geometry in _geometries(path) if geometry], object
            )
    except FileNotFoundError:
        raise DataError(f"{where}: no such file") from None
    except (*UNREADABLE, shapely.errors.ShapelyError) as error:
        raise DataError(f"{where}: not readable as GeoJSON ({explain_error(error)})") from None
    while (shapely.get_type_id(parts) > POLYGON).any():
        parts = shapely.get_parts(parts)
    kind = shapely.get_type_id(parts)
    if not (kind == POLYGON).any() and not (lines_too and (kind == LINE).any()):
        raise DataError(
            f"{where}: holds no polygon{' and no line' * lines_too}; draw one, as in a GIS"
        )
    parts, kind = parts[np.isin(kind, (LINE, POLYGON))], kind[np.isin(kind, (LINE, POLYGON))]

    def in_metres(places: np.ndarray) -> np.ndarray:
        if not np.isfinite(places).all():
            raise DataError(f"{where}: a corner is NaN or infinite")
        if origin is not None:
            return _to_metres(places, origin, where)
        if np.abs(places).max(initial=0) > FARTHEST:
            far = f"{np.abs(places).max():.3g} is no coordinate in metres"
            raise DataError(
                f"{where}: {far}; give those of the measurements, within {FARTHEST:g} m"
            )
        return places

    parts = shapely.transform(parts, in_metres)
    polygons, lines = parts[kind == POLYGON], parts[kind == LINE]
    if not ((shapely.area(polygons) > 0).all() and (shapely.length(lines) > 0).all()):
        raise DataError(f"{where}: an empty polygon or line, its corners enclose nothing")
    wide = float(np.ptp(shapely.get_coordinates(parts), axis=0).max())
    if origin is None and wide < SPECK * site_m:
        raise DataError(
            f"{where}: all of it is {wide:.2g} m wide, the site {site_m:.3g} m; the model "
            "was trained in metres about an unknown origin, which degrees mean nothing to"
        )
    return shapely.union_all(shapely.make_valid(polygons)), list(lines)


def read_outlines(settings: Mapping[str, Any], origin: Georeference | None) -> list[np.ndarray]:
    """Return the lines (n, 2) [m] of all files that settings name, and the rims of their polygons:
    what is drawn behind a map.
    """
    outlines = []
    for key in ("area", "buildings", "walkable"):
        if is_drawn(settings.get(key)):
            area, lines = read_shapes(settings[key], key, origin, True)
            rims = [rim for part in _polygons(area) for rim in (part.exterior, *part.interiors)]
            outlines += [np.asarray(line.coords)[:, :2] for line in (*rims, *lines)]
    return outlines


def _polygons(area: Any) -> list[Any]:
    from shapely import get_parts

    return [part for part in get_parts(area) if part.geom_type == "Polygon"]


def write_way(
    path: Path, stops: Mapping[str, np.ndarray], corners: Mapping[str, np.ndarray]
) -> None:
    """Write a way as a line through its corners, and stops as points with their columns; places are
    `longitude` and `latitude` where these are columns, else `x` and `y`.
    """
    names = ["longitude", "latitude"] if "longitude" in corners else ["x", "y"]
    line = np.column_stack([corners[name] for name in names]).tolist()
    shapes: list[tuple[dict[str, Any], Any]] = [({"type": "LineString", "coordinates": line}, {})]
    for row in pd.DataFrame(stops).to_dict("records"):
        shapes.append(({"type": "Point", "coordinates": [row[name] for name in names]}, row))
    write_shapes(path, shapes)


def write_shapes(path: Path, shapes: list[tuple[dict[str, Any], Any]]) -> None:
    """Write geometries, each with its properties."""
    features = [
        {"type": "Feature", "properties": facts, "geometry": shape} for shape, facts in shapes
    ]
    write_whole(path, json.dumps({"type": "FeatureCollection", "features": features}))

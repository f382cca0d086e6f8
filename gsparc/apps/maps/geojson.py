"""Polygons and lines of a GeoJSON file (RFC 7946) in world metres."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

from gsparc.data.assemble import FARTHEST
from gsparc.data.errors import DataError, reason
from gsparc.data.links.georeference import Georeference

SPECK = 1e-3  # of a site's width, that nobody draws: in degrees a site is 1e-5 as wide as in metres


@dataclass(frozen=True)
class Shapes:
    """What a file draws.

    Attributes:
        polygons: each a list of rings (n, 2) [m], the outer one first, the others holes.
        lines: (n, 2) [m] each.
    """

    polygons: tuple[tuple[np.ndarray, ...], ...]
    lines: tuple[np.ndarray, ...]

    def contains(self, places: np.ndarray) -> np.ndarray:
        """Which of places (n, 2) [m] lie in a polygon and in none of its holes, (n,) bool."""
        inside = np.zeros(len(places), bool)
        for outer, *holes in self.polygons:
            here = Outline(outer).contains_points(places)
            for hole in holes:
                here &= ~Outline(hole).contains_points(places)
            inside |= here
        return inside

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (2,) [m] of everything."""
        every = np.concatenate([*(rings[0] for rings in self.polygons), *self.lines])
        return every.min(axis=0), every.max(axis=0)


def read_shapes(
    path: str | Path, key: str, origin: Georeference | None, lines_too: bool = False, site_m: float = 0.0
) -> Shapes:
    """Polygons and lines of a file; coordinates are degrees where the model knows its place on Earth.

    Args:
        path: `*.geojson` or `*.json`.
        key: setting that named it, for messages.
        origin: of the model's metres; None: the file's coordinates are metres themselves.
        lines_too: whether lines will do where there are no polygons.
        site_m: width of the site [m], of which everything drawn must not be a speck: it is in degrees then.

    Raises:
        DataError: no file, no GeoJSON, no such shapes, one without extent, or degrees.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise DataError(f"{key}={path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{key}={path}: not readable as GeoJSON ({reason(error)})") from None
    polygons: list[tuple[np.ndarray, ...]] = []
    lines: list[np.ndarray] = []
    if not isinstance(content, dict) or "type" not in content:
        raise DataError(f"{key}={path}: not GeoJSON; expected an object with a type")
    for number, geometry in enumerate(_geometries(content)):
        where = f"{key}={path}, geometry {number}"
        kind, parts = geometry.get("type"), geometry.get("coordinates")
        if kind in ("Polygon", "MultiPolygon"):
            for rings in [parts] if kind == "Polygon" else parts or []:
                polygons.append(tuple(_ring(ring, where, origin) for ring in rings or [[]]))
        elif kind in ("LineString", "MultiLineString"):
            for line in [parts] if kind == "LineString" else parts or []:
                lines.append(_points(line, where, origin, 2))
    if not polygons and not (lines and lines_too):
        raise DataError(f"{key}={path}: holds no polygon; draw the area as a Polygon or MultiPolygon")
    shapes = Shapes(tuple(polygons), tuple(lines))
    low, high = shapes.bounds()
    if origin is None and (high - low).max() < SPECK * site_m:
        raise DataError(
            f"{key}={path}: all of it is {(high - low).max():.2g} m wide, the site {site_m:.3g} m; the model "
            "was trained in metres about an unknown origin, which degrees mean nothing to"
        )
    return shapes


def _geometries(content: Any) -> Iterator[dict[str, Any]]:
    """Geometries of a file, those of features and collections one after another."""
    if isinstance(content, dict):
        inner = [content[key] for key in ("features", "geometries", "geometry") if key in content]
        if not inner:
            yield content
        for part in (one for group in inner for one in (group if isinstance(group, list) else [group])):
            yield from _geometries(part)


def _ring(ring: Any, where: str, origin: Georeference | None) -> np.ndarray:
    places = _points(ring, where, origin, 3)
    following = np.roll(places, -1, axis=0)
    area = 0.5 * abs(float(np.sum(places[:, 0] * following[:, 1] - following[:, 0] * places[:, 1])))
    if not area > 0:
        raise DataError(f"{where}: an empty polygon, its corners enclose nothing")
    return places


def _points(pairs: Any, where: str, origin: Georeference | None, least: int) -> np.ndarray:
    try:
        places = np.array([point[:2] for point in pairs], dtype=np.float64)
    except (TypeError, ValueError, IndexError):
        raise DataError(f"{where}: coordinates are not pairs of numbers") from None
    if len(np.unique(places, axis=0)) < least:
        raise DataError(f"{where}: {len(places)} corners; at least {least} distinct ones are needed")
    if not np.isfinite(places).all():
        raise DataError(f"{where}: a corner is NaN or infinite")
    if origin is not None:
        try:
            return origin.from_degrees(places[:, 1], places[:, 0])
        except DataError as error:
            raise DataError(f"{where}: {error} (longitude first, then latitude)") from None
    if np.abs(places).max() > FARTHEST:
        raise DataError(f"{where}: {np.abs(places).max():.3g} is no coordinate in metres")
    return places

"""Rasters of planning tools: GeoTIFF, BIL, ASCII grids, lists of x, y and level, and overlays of a
globe, whose colours a legend explains.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from gsparc.base.errors import DataError, list_first, readable
from gsparc.base.files import read_text
from gsparc.base.limits import parse_numbers
from gsparc.data.georeference import Georeference
from gsparc.data.station_names import site_name
from gsparc.data.units import UNITS
from gsparc.physics.decibels import to_decibels

log = logging.getLogger(__name__)

GRIDS, LISTS, OVERLAY = (".tif", ".tiff", ".bil", ".asc"), (".txt", ".csv", ".xyz"), ".kml"
DEGREES = "EPSG:4326"
LONGEST = 200  # characters of a first line that may be numbers
LOCAL = "local"  # in place of a projection: metres of the measurements
COLOUR = re.compile(r"#?([0-9a-fA-F]{6})=([-+]?\d*\.?\d+)")
# Of the strongest station, as `gsparc map` writes; with a name behind it of one of several
BAND = "power_db"
CORNERS = ("north", "south", "east", "west")


@dataclass(frozen=True)
class RasterFile:
    """Squares of a map.

    Attributes:
        points: (M, 2) centres, x and y in the file's projection, row by row from the north.
        crs: the projection, as rasterio takes it; None: metres of the measurements.
        names, units: (B,) of the bands, empty where the file states none.
        bands: (B, M) values by the file's scale and offset; NaN: no value.
    """

    points: np.ndarray
    crs: object
    names: tuple[str, ...]
    units: tuple[str, ...]
    bands: np.ndarray

    def locate(self, origin: Georeference | None, path: Path) -> np.ndarray:
        """Return the centres (M, 2) [m] about the origin of the measurements.

        Raises:
            DataError: the raster has a place on Earth and the measurements have none.
        """
        if self.crs is None:
            return self.points
        if origin is None:
            raise DataError(f"{path}: it has a place on Earth, which the measurements do not state")
        return origin.from_degrees(*self._degrees(path, self.points))

    def middle(self, path: Path) -> Georeference | None:
        """Return an origin in its middle; None: its metres are those of the measurements.

        Raises:
            DataError: no such projection, or it leads off the Earth.
        """
        if self.crs is None:
            return None
        degrees = self._degrees(path, (self.points.min(0) + self.points.max(0))[None] / 2)
        return Georeference.from_coordinates(*degrees)

    def levels(
        self,
        path: Path,
        origin: Georeference | None,
        stations: Collection[str] = (),
        key: str = "model.prior",
    ) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Yield name, centres (M, 2) [m] of squares and their levels (M,) [dB], of named bands,
        else of `BAND` or of the first.

        Args:
            path: of the file, for messages.
            origin: of the measurements' metres; None: the file must be in metres itself.
            stations: names that bands may have.
            key: setting that named the file.

        Raises:
            DataError: no place, or a unit of no powers.
        """
        titles = self.names
        single = {"": titles.index(BAND) if BAND in titles else 0}
        known = {*stations, *map(site_name, stations)}
        named = [t.removeprefix(f"{BAND} ") for t in titles]
        bands = {t: k for k, t in enumerate(named) if t != titles[k] or t in known}
        if not bands and len(titles) > 1 and BAND not in titles:
            # Of others: as a station alone is asked for, none of them is known
            if stations and all(titles):
                bands = {t: k for k, t in enumerate(named)}
            else:
                shown = list_first([title or f"{k}" for k, title in enumerate(titles, 1)])
                log.warning("%s=%s: the first of its bands %s is taken", key, path, shown)
        points, where = self.locate(origin, path), f"{key}={path}"
        for name, band in (bands or single).items():
            yield name, points, _to_decibels(where, self.bands[band], self.units[band])

    def _degrees(self, path: Path, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Latitudes and longitudes (n,) of points (n, 2)."""
        from rasterio.warp import transform

        with readable(path, "no such projection", ValueError):
            longitude, latitude = transform(self.crs, DEGREES, *points.T)
        return np.asarray(latitude), np.asarray(longitude)


def is_raster(path: Path, settings: Mapping[str, object]) -> bool:
    """Tell a raster from a table of places and powers, which have heads or names of stations.

    Args:
        path: of the file.
        settings: beside its name; `crs` is of a raster alone.
    """
    suffix = path.suffix.lower()
    if suffix == OVERLAY:  # others hold points
        return b"<GroundOverlay" in path.read_bytes()
    if suffix not in LISTS or "crs" in settings:
        return suffix in (*GRIDS, *LISTS)
    with path.open(encoding="utf-8", errors="replace") as file:
        words = re.split(r"[\s,;]+", file.readline(LONGEST).strip().lower())
    return words == [*"xyz"] or (len(words) == 3 and len(parse_numbers(words)) == 3)


def read_raster(
    path: Path,
    crs: str | None = None,
    nodata: float | str | None = None,
    legend: Sequence[str] | None = None,
) -> RasterFile:
    """Read all bands.

    Args:
        path: of the file.
        crs: projection of a file that states none; `local`: metres of the measurements.
        nodata: value of squares without one, where the file states none; `none`: all have one.
        legend: of an overlay, its colours like `ff8000=-85`, red, green, blue and decibels.

    Raises:
        DataError: it is none, rasterio is missing, or what the file does not state is not said.
    """
    suffix = path.suffix.lower()
    if suffix == OVERLAY:
        return _read_overlay(path, legend)
    if suffix in LISTS and (crs is None or nodata is None):
        how = f'{{file: {path}, crs: "EPSG:32617", nodata: -9999}}'
        raise DataError(
            f"{path}: a list of x, y and level states no projection and no mark of "
            f"what is absent; say both, {how} (crs: {LOCAL}, nodata: none where there are none)"
        )
    try:
        import rasterio
        from rasterio.errors import RasterioError
    except ImportError:
        raise DataError(f"{path}: needs rasterio; pip install 'gsparc[maps]'") from None
    with (
        readable(path, "no raster", (RasterioError, ValueError)),
        rasterio.open(path, driver="XYZ" if suffix in LISTS else None) as file,
    ):
        row, column = np.mgrid[: file.height, : file.width]
        points = np.stack(file.transform @ (column.ravel() + 0.5, row.ravel() + 0.5), axis=1)
        stored = file.read(masked=nodata is None).astype(float)
        bands = np.ma.filled(stored, np.nan).reshape(file.count, -1)
        if nodata not in (None, "none"):
            bands = np.where(bands == float(nodata), np.nan, bands)
        bands = bands * np.array(file.scales)[:, None] + np.array(file.offsets)[:, None]
        titles, units = ([str(text or "") for text in of] for of in (file.descriptions, file.units))
        stated = None if crs == LOCAL else file.crs or crs
    return RasterFile(points, stated, tuple(titles), tuple(units), bands)


def _to_decibels(where: str, values: np.ndarray, name: str) -> np.ndarray:
    """Levels of values whose unit a file names, if it names one;
    `DataError` where that is none of powers.
    """
    unit = UNITS.get(name.lower())
    if unit is None:
        return values
    if unit.kind not in ("level", "power"):
        raise DataError(f"{where}: its unit is {name}; levels are needed, or powers such as mW")
    with np.errstate(divide="ignore", invalid="ignore"):  # of no power nothing is known
        return (
            to_decibels(unit.convert(values)) + 30 if unit.kind == "power" else unit.convert(values)
        )


def _read_overlay(path: Path, legend: Sequence[str] | None) -> RasterFile:
    """Colours of a ground overlay as the levels of the nearest colour of the legend.

    A level is right to half a step of the legend; colours farther than that have none.
    """
    if not legend:
        how = f'{{file: {path}, legend: ["ff0000=-70", "0000ff=-110"]}}'
        raise DataError(f"{path}: colours, not levels; state what they mean, {how}")
    matches = [COLOUR.fullmatch(str(entry)) for entry in legend]
    if len(legend) < 2 or not all(matches):
        raise DataError(f"{path}: legend: two colours at least like ff0000=-70")
    entries = sorted((float(match[2]), bytes.fromhex(match[1])) for match in matches if match)
    level, known = np.array([db for db, _ in entries]), np.array([[*c] for _, c in entries], float)
    step = np.linalg.norm(np.diff(known, axis=0), axis=1)  # from one to the next stronger
    reach = np.maximum(np.r_[0, step], np.r_[step, 0]) / 2 + 1  # and one of rounding
    with readable(path, "no ground overlay", (ElementTree.ParseError, ValueError)):
        root = ElementTree.fromstring(read_text(path, "missing"))
        text = {node.tag.rpartition("}")[2]: (node.text or "").strip() for node in root.iter()}
        if float(text.get("rotation", 0)) or not {*CORNERS, "href"} <= text.keys():
            raise ValueError("expected an unturned LatLonBox and the name of one image")
        north, south, east, west = (float(text[name]) for name in CORNERS)
    with (
        readable(path, "no image", (OSError, ValueError)),
        Image.open(path.parent / text["href"]) as image,
    ):
        pixels, (width, height) = image.convert("RGBA").tobytes(), image.size
    row, column = np.mgrid[:height, :width]
    x = west + (east - west) * (column.ravel() + 0.5) / width
    y = north - (north - south) * (row.ravel() + 0.5) / height
    shades, shade = np.unique(np.frombuffer(pixels, "<u4"), return_inverse=True)
    colours = shades.view(np.uint8).reshape(-1, 4).astype(float)
    away = np.linalg.norm(colours[:, None, :3] - known, axis=2)
    nearest = away.argmin(1)
    told = (away.min(1) <= reach[nearest]) & (colours[:, 3] > 0)
    bands = np.where(told, level[nearest], np.nan)[shade.reshape(1, -1)]
    return RasterFile(np.c_[x, y], DEGREES, ("",), ("",), bands)

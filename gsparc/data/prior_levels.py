"""Levels that a file states of a site before any row: a GeoTIFF, or places and powers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsparc.data.datasets.own import read_own
from gsparc.data.errors import DataError
from gsparc.data.own import interpret
from gsparc.data.schema import Measurements

BAND = "power_db"  # of the strongest station, as `gsparc map` writes; with a name behind it of one of several
MOST = 4_000_000  # levels: they are kept with a model
ABOUT_M = 100.0  # least distance from the box of rows and stations that levels are kept within [m]


def read_prior_levels(
    path: str | Path, data: Measurements, station: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return places (M, 2) [m] in the world coordinates of the measurements, and levels (M,) [dB] there.

    Args:
        path: *.tif, or what `dataset=own` reads.
        data: measurements, which the levels must overlap.
        station: whose levels are wanted where the file has those of several.

    Raises:
        DataError: no such file, no levels, none of this station, or of another place.
    """
    path = Path(path)
    if path.suffix == ".ckpt":
        raise DataError(f"model.prior={path}: draw it first, gsparc map ckpt={path}, and give its map.tif")
    if not path.is_file():
        raise DataError(
            f"model.prior={path}: no such file; a GeoTIFF is needed, or a table of places and powers"
        )
    read = _read_raster if path.suffix in (".tif", ".tiff") else _read_rows
    points, level = read(path, data, station)
    finite = np.isfinite(level) & np.isfinite(points).all(1)
    if not finite.any():
        raise DataError(f"model.prior={path}: no level is known in it")
    points, level = points[finite], level[finite]
    at = data.moving[:, :2] + data.site.origin[:2]
    if not ((at >= points.min(0) - 1) & (at <= points.max(0) + 1)).all(1).any():
        box, rows = (
            f"x {a:.0f} to {b:.0f}, y {c:.0f} to {d:.0f} m" for (a, b), (c, d) in map(_extent, (points, at))
        )
        raise DataError(f"model.prior={path}: it is of {box}, and all rows lie elsewhere: {rows}")
    # Of a whole country only what lies about rows and stations is kept.
    margin, still = max(float(np.ptp(at, axis=0).max()), ABOUT_M), data.site.every_station.position[:, :2]
    ends = np.r_[at, still[np.isfinite(still).all(1)] + data.site.origin[:2]]
    near = ((points >= ends.min(0) - margin) & (points <= ends.max(0) + margin)).all(1)
    if near.sum() > MOST:
        raise DataError(
            f"model.prior={path}: {near.sum():,} levels about the rows; {MOST:,} at most are kept"
        )
    return points[near], level[near]


def _extent(points: np.ndarray) -> np.ndarray:
    """Lowest and highest (2, 2) of each coordinate."""
    return np.stack([points.min(0), points.max(0)], 1)


def _number(names: Sequence[str], station: str | None, path: Path) -> int:
    """The place of a station among the names of a file; of one name that."""
    if len(names) > 1 and station not in names:
        raise DataError(f"model.prior={path}: of {', '.join(names)}, not of {station or 'one station'}")
    return 0 if len(names) == 1 or station is None else list(names).index(station)


def _read_raster(path: Path, data: Measurements, station: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Centres of squares and their levels, of the band of a station, of `BAND`, or of the first band."""
    try:
        import rasterio
        from rasterio.warp import transform
    except ImportError:
        raise DataError(f"model.prior={path}: needs rasterio; pip install 'gsparc[maps]'") from None
    with rasterio.open(path) as file:
        titles = [str(title or "") for title in file.descriptions]
        bands = {
            title.removeprefix(f"{BAND} "): k
            for k, title in enumerate(titles)
            if title.startswith(f"{BAND} ")
        }
        band = titles.index(BAND) if BAND in titles else 0
        band = bands[list(bands)[_number(list(bands), station, path)]] if bands else band
        level = file.read(band + 1, masked=True).astype(float).filled(np.nan).ravel()
        row, column = np.mgrid[: file.height, : file.width]
        x, y = file.transform @ (column.ravel() + 0.5, row.ravel() + 0.5)
        crs, origin = file.crs, data.site.georeference
    if crs is None:
        return np.c_[x, y], level
    if origin is None:
        raise DataError(f"model.prior={path}: it has a place on Earth, which the measurements do not state")
    longitude, latitude = (np.asarray(one) for one in transform(crs, "EPSG:4326", x, y))
    return origin.from_degrees(latitude, longitude), level


def _read_rows(path: Path, data: Measurements, station: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Places and levels of a table or an npz."""
    rows = interpret(read_own(path), path).data
    if not rows.site.maps_levels:
        raise DataError(f"model.prior={path}: no powers of one end that moves")
    of_station = rows.stations_of() == _number(rows.site.every_station.shown, station, path)
    points = (rows.moving + rows.site.origin)[of_station, :2]
    theirs, ours = rows.site.georeference, data.site.georeference
    if theirs is not None and ours is not None:
        points = ours.from_degrees(*theirs.to_degrees(points))
    return points, rows.site.target.to_real(rows.target[of_station])[:, 0].astype(float)

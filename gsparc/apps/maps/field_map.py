"""What a map holds, its layers over all stations (which serves, its ratio, its outage),
and its files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.geojson import write_shapes
from gsparc.base.errors import DataError
from gsparc.base.files import whole_file, write_archive
from gsparc.base.limits import finite_array
from gsparc.physics.decibels import from_decibels, to_decibels

REFUSED = -1  # of `best_server`
NO_CLASS = 65535  # in a file of classes
OVERLAP_DB = 6.0  # below the strongest, where another disturbs and hands over
# Quantiles of the strongest that rivals are weighed against
SHARES = ((np.arange(16) + 0.5) / 16)[:, None]
OF_STATIONS = ("power_db", "lower_db", "upper_db", "expected_error_db")
ARRAYS = (*OF_STATIONS, "sinr_db", "outage", "best_server", "server_chance")


@dataclass(frozen=True)
class FieldMap:
    """Predictions for the cells of a grid; float32, NaN where they are refused.

    Attributes:
        grid: the cells, world.
        stations: (T,) names; one, "", where there is one.
        power_db: (T, ny, nx) received power.
        lower_db, upper_db: (T, ny, nx) ends of the interval.
        expected_error_db: (T, ny, nx) root mean square error.
        best_server: (ny, nx) int16, number of the strongest station; `REFUSED`.
        server_chance: (ny, nx) probability that it is, and is above its floor; see `server_chance`.
        sinr_db: (ny, nx) of the strongest station, over the others' load and noise.
        outage: (ny, nx) probability that all powers lie below `threshold_db`.
        share: of measurements that the intervals hold; the field alone lies in them more often.
        calibrated: whether held-out blocks say so; else the model's own deviations alone.
        threshold_db: of `outage`.
        extra: further layers (ny, nx) by name: `overlap` of several stations.
        places: (n, 2) where was measured, world [m].
        station_place: (T, 2) world [m], NaN where unknown.
        notes: what a reader must know, one line each.
        unit: of all levels.
        azimuth: (T,) that sectors face [deg from north], NaN of others.
        bands: (T,) carriers of the stations; () of one.
        site: (T,) int64 of the stations.
        number: (T,) int64 of the stations in the model.
    """

    grid: Grid
    stations: tuple[str, ...]
    power_db: np.ndarray
    lower_db: np.ndarray
    upper_db: np.ndarray
    expected_error_db: np.ndarray
    best_server: np.ndarray
    server_chance: np.ndarray
    sinr_db: np.ndarray
    outage: np.ndarray
    share: float
    calibrated: bool
    threshold_db: float
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    places: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    station_place: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    notes: tuple[str, ...] = ()
    unit: str = "dB"
    azimuth: np.ndarray = field(default_factory=lambda: np.zeros(0))
    bands: tuple[str, ...] = ()
    site: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    number: np.ndarray = field(default_factory=lambda: np.zeros(1, np.int64))

    @property
    def refused(self) -> np.ndarray:
        """Cells (ny, nx) bool of the area about which nothing is said."""
        return self.grid.inside & (self.best_server == REFUSED)

    @property
    def unsure(self) -> np.ndarray:
        """Cells (ny, nx) bool whose best server is less likely than not strongest
        and above its floor.
        """
        return np.nan_to_num(self.server_chance, nan=1.0) < 0.5

    def at_best_server(self, layers: np.ndarray) -> np.ndarray:
        """Return, of layers (T, ny, nx), each cell's strongest station's (ny, nx);
        NaN where refused.
        """
        number = np.maximum(self.best_server, 0).astype(np.int64)
        chosen = np.take_along_axis(layers, number[None], axis=0)[0]
        return np.where(self.best_server == REFUSED, np.nan, chosen)

    def to_unit(self, decibels: float, unit: str) -> FieldMap:
        """Return the same map with levels so many decibels higher, which is in another unit."""
        # Errors and probabilities do not change with the unit, differences of levels neither.
        levels = {name: getattr(self, name) + np.float32(decibels) for name in OF_STATIONS[:3]}
        return replace(self, **levels, threshold_db=self.threshold_db + decibels, unit=unit)

    def layer(self, name: str) -> np.ndarray:
        """Return one of `ARRAYS` (ny, nx), of the strongest station; NaN where refused."""
        if name == "best_server":
            return np.where(self.best_server == REFUSED, np.nan, self.best_server)
        values = getattr(self, name)
        return self.at_best_server(values) if name in OF_STATIONS else values

    def save(self, path: str | Path) -> None:
        """Write as npz, whole or not at all."""
        arrays = {
            "x": self.grid.x,
            "y": self.grid.y,
            "height": np.array(self.grid.height),
            "inside": self.grid.inside,
            "stations": np.array(self.stations),
            "share": np.array(self.share),
            "calibrated": np.array(self.calibrated),
            "threshold_db": np.array(self.threshold_db),
            "unit": np.array(self.unit),
            "bands": np.array(self.bands, str),
            **{name: getattr(self, name) for name in ARRAYS},
            **self.extra,
        }
        write_archive(path, arrays)

    def summarise(self) -> dict[str, float | int | str | None]:
        """Return `map/*` for `summary.json`; shares are of the cells that something is said of."""
        mask = self.grid.inside & ~self.refused

        def reduce(
            layer: np.ndarray, reduced: Callable[[np.ndarray], Any] = np.mean
        ) -> float | None:
            values = layer[mask & np.isfinite(layer)]
            return float(reduced(values)) if len(values) else None

        power = self.layer("power_db")
        figures = {
            "cells": int(self.grid.inside.sum()),
            "refused": int(self.refused.sum()),
            "step_m": self.grid.step,
            "height_m": self.grid.height,
            "stations": len(self.stations),
            "lowest_db": reduce(power, np.min),
            "highest_db": reduce(power, np.max),
            "width_db": reduce(self.at_best_server(self.upper_db - self.lower_db)),
            "expected_error_db": reduce(
                self.layer("expected_error_db"), lambda v: np.sqrt(np.mean(v**2))
            ),
            "threshold_db": self.threshold_db,
            "outage": reduce(self.outage),
            "sinr_db": reduce(self.sinr_db),
            "server_unsure": reduce(1.0 * self.unsure),
        }
        return {f"map/{name}": value for name, value in figures.items()} | {"map/unit": self.unit}


def empty_layers(stations: int, shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return `ARRAYS` of a map (ny, nx) about which nothing is said yet."""
    shapes = {name: (stations, *shape) if name in OF_STATIONS else shape for name in ARRAYS}
    values = {name: np.full(size, np.nan, np.float32) for name, size in shapes.items()}
    return values | {"best_server": np.full(shape, REFUSED, np.int16)}


def best_server(power_db: np.ndarray) -> np.ndarray:
    """Number of the strongest of (T, n) powers [dB], (n,) int16; `REFUSED` where none is known."""
    finite = np.isfinite(power_db)
    # -inf, since argmax takes the first NaN for the largest.
    number = np.where(finite, power_db, -np.inf).argmax(axis=0)
    return np.where(finite.any(axis=0), number, REFUSED).astype(np.int16)


def server_chance(
    power_db: np.ndarray,
    error_db: np.ndarray,
    floor_db: np.ndarray,
    alike: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the probability (n,) that the strongest of (T, n) powers is,
    and lies above its station's floor.

    Errors are taken for normal. Given the strongest's own level its rivals are taken for
    independent: who beats one station is likelier to beat another,
    and the product of all chances alone is far too small.

    Args:
        power_db, error_db: predicted, and expected errors; NaN where unknown, which counts as
            weaker: far from where a station was measured it is some 25 dB below its usual level.
        floor_db: (T,) power below which a station is not told from noise; -inf: any is.
        alike: (T, n) correlations of errors with the strongest's: sectors of a site share its
            shadowing.

    Returns:
        NaN where no power is known.
    """
    known, first, cell = _strongest(power_db)
    mean, spread = power_db[first, cell], error_db[first, cell]
    above = ndtr((mean - floor_db[first]) / spread)
    z = ndtri(1 - np.maximum(above, 1e-12) * SHARES)  # equally likely levels above the floor
    beaten = _chance_all_below(mean + spread * z, power_db, error_db, alike, z, first)
    return np.where(known, above * beaten, np.nan).astype(np.float32)


def _strongest(power_db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a power of (T, n) is known in each cell (n,), the strongest's number there,
    and the cell's.
    """
    number = best_server(power_db)
    return number != REFUSED, np.maximum(number, 0), np.arange(power_db.shape[1])


def outage_probability(
    power_db: np.ndarray,
    error_db: np.ndarray,
    threshold_db: float,
    alike: np.ndarray,
    below: np.ndarray,
) -> np.ndarray:
    """Return the probability (n,) that all of (T, n) powers lie below a threshold:
    who misses one may hear another.

    Errors are normal; given the strongest's level its rivals are independent, and what is unknown
    counts as below, as in `server_chance`.

    Args:
        power_db, error_db, alike: see `server_chance`.
        threshold_db: in the unit of the powers.
        below: (n,) probability that the strongest lies below it.
    """
    z = ndtri(np.clip(below, 1e-12, 1) * SHARES)  # equally likely levels of the strongest below it
    limit, first = np.full(z.shape, threshold_db), np.maximum(best_server(power_db), 0)
    return (below * _chance_all_below(limit, power_db, error_db, alike, z, first)).astype(
        np.float32
    )


def _chance_all_below(
    limit: np.ndarray,
    rival: np.ndarray,
    wrong: np.ndarray,
    alike: np.ndarray | float,
    z: np.ndarray,
    first: np.ndarray,
) -> np.ndarray:
    """Chance (n,) that all of (T, n) rivals lie below limits (K, n),
    mean over K normal errors of `first`.

    Unknown ones do.
    """
    # Of a rival given the strongest: never 0, which would divide.
    spread, total, cell = (
        wrong * np.sqrt(np.maximum(1 - np.square(alike), 1e-6)),
        0.0,
        np.arange(len(first)),
    )
    for level, error in zip(limit, z, strict=True):
        below = ndtr((level - rival - alike * wrong * error) / spread)
        below[first, cell] = 1.0
        total = total + np.nan_to_num(below, nan=1.0).prod(axis=0)
    return np.asarray(total / len(z))


def sinr(
    power_db: np.ndarray,
    load: np.ndarray,
    noise_db: float | None,
    carrier: np.ndarray | None = None,
) -> np.ndarray:
    """Signal over interference and noise (n,) [dB] of the strongest of (T, n) powers,
    within its carrier.

    Args:
        power_db: NaN where unknown: such a station is taken for silent.
        load: (T,) share of the time that each transmits while another serves.
        noise_db: power of the noise, in the unit of the powers; None: interference alone.
        carrier: (T,) int64; None: all transmit on one.

    Returns:
        NaN where no power is known, or where there is neither noise nor interference.
    """
    # float64: 10^(-12) beside 10^(-4) keeps no digit of interference in float32.
    linear = np.where(np.isfinite(power_db), from_decibels(power_db.astype(np.float64)), 0.0)
    known, first, cell = _strongest(power_db)
    signal = linear[first, cell]
    same = True if carrier is None else carrier[:, None] == carrier[first]
    received = load @ (linear * same) - load[first] * signal
    noise = 0.0 if noise_db is None else from_decibels(noise_db)
    # The sum less its own part may round below 0 where one station is alone.
    rest = np.maximum(received, 0.0) + noise
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = to_decibels(signal / rest)
    return np.where(known & (rest > 0), ratio, np.nan)


def count_overlap(power_db: np.ndarray, carrier: np.ndarray) -> np.ndarray:
    """Count stations (n,) within `OVERLAP_DB` of the strongest of (T, n) powers [dB], itself too,
    on its carrier.

    Returns:
        NaN where no power is known.
    """
    known, first, cell = _strongest(power_db)
    near = (power_db >= power_db[first, cell] - OVERLAP_DB) & (carrier[:, None] == carrier[first])
    return np.where(known, near.sum(0), np.nan).astype(np.float32)


def read_loads(
    load: float | Sequence[float] | Mapping[str, float],
    stations: Sequence[str],
    labels: Sequence[str] = (),
) -> np.ndarray:
    """Return loads (T,) in [0, 1] of one number, one per station,
    or by name or label (the others 1).

    Raises:
        DataError: another number of them, an unknown name, or no share.
    """
    if isinstance(load, Mapping):
        if wrong := sorted(load.keys() - {*stations, *labels}):
            raise DataError(f"load: no station {wrong[0]!r}; there are {', '.join(stations)}")
        load = [
            load.get(a, load.get(b, 1.0)) for a, b in zip(stations, labels or stations, strict=True)
        ]
    values = finite_array(load)
    if (
        values.ndim > 1
        or values.size not in (1, len(stations))
        or not ((values >= 0) & (values <= 1)).all()
    ):
        fault = f"shares from 0 to 1 are needed: one number, or {len(stations)}, one per station"
        raise DataError(f"load={load}: {fault}")
    return np.broadcast_to(values, (len(stations),))


def check_geotiff(wanted: bool | None) -> bool:
    """Return whether a GeoTIFF is written; None: where it can be.

    Raises:
        DataError: it is asked for, and cannot be.
    """
    there = find_spec("rasterio") is not None
    if wanted and not there:
        raise DataError("geotiff=true: needs rasterio; pip install 'gsparc[maps]'")
    return there and wanted is not False


def write_geotiff(path: str | Path, raster: FieldMap) -> None:
    """Write float32 bands, north up; named, NaN where nothing is said.

    Bands are of the strongest station: `power_db`, `lower_db`, `upper_db`, `expected_error_db`,
    `sinr_db`, `outage`, `best_server` (number of the station, as in `write_classes`),
    `server_chance`, and then the power of each of several stations. Tags give unit,
    threshold and height.
    """
    import rasterio

    bands = {**{name: raster.layer(name) for name in ARRAYS}, **raster.extra}
    if len(raster.stations) > 1:
        bands |= {f"power_db {name}": raster.power_db[i] for i, name in enumerate(raster.stations)}
    profile = raster_profile(raster, count=len(bands), dtype="float32", nodata=float("nan"))
    with whole_file(path) as partial, rasterio.open(partial, "w", **profile) as file:
        file.update_tags(
            unit=raster.unit, threshold_db=raster.threshold_db, height_m=raster.grid.height
        )
        for number, (name, values) in enumerate(bands.items(), 1):
            # GeoTIFF rows go from north to south, ours from south to north.
            file.write(np.flipud(values).astype(np.float32), number)
            file.set_band_description(number, name)
            unit = raster.unit if name.startswith(("power", "lower", "upper")) else "dB"
            file.set_band_unit(number, unit if "_db" in name else "")


def write_classes(
    path: str | Path,
    raster: FieldMap,
    number: np.ndarray,
    names: Sequence[str],
    colours: np.ndarray,
) -> None:
    """Write numbers (ny, nx) of classes with a table of their colours (k, 3),
    and named areas as GeoJSON.
    """
    import rasterio
    from rasterio.features import shapes
    from rasterio.warp import transform_geom

    values = np.flipud(np.where(np.isfinite(number), number, NO_CLASS)).astype(np.uint16)
    profile = raster_profile(raster, count=1, dtype="uint16", nodata=NO_CLASS)
    with whole_file(path) as partial, rasterio.open(partial, "w", **profile) as file:
        # Before the values, which fix what colours mean.
        file.write_colormap(
            1, {i: tuple((255 * colour[:3]).astype(int)) for i, colour in enumerate(colours)}
        )
        file.write(values, 1)
    named = []
    for area, shape in shapes(values, values != NO_CLASS, transform=profile["transform"]):
        area = (
            area
            if raster.grid.origin is None
            else transform_geom(profile["crs"], "EPSG:4326", area)
        )
        named.append((area, {"number": int(shape), "station": names[int(shape)]}))
    write_shapes(Path(path).with_suffix(".geojson"), named)


def raster_profile(raster: FieldMap, **bands: Any) -> dict[str, Any]:
    """What rasterio is told of a file and its `bands`, in the projection of `Georeference`.

    Azimuthal equidistant, in which squares of the grid are squares: UTM would turn and resample
    them. Without an origin coordinates are metres.
    """
    from rasterio.transform import from_origin

    (west, _, _, north), origin = raster.grid.extent, raster.grid.origin
    # Without a title programs show it as "unknown".
    form = "+proj=aeqd +datum=WGS84 +lat_0={0!r} +lon_0={1!r} +title=equidistant_about_{0}_{1}"
    place = None if origin is None else form.format(origin.latitude, origin.longitude)
    return {
        "driver": "GTiff",
        "width": len(raster.grid.x),
        "height": len(raster.grid.y),
        "crs": place,
        **bands,
        "transform": from_origin(west, north, raster.grid.step, raster.grid.step),
        "compress": "deflate",
        "tiled": True,
    }

"""A map as files of a GIS: rasters by rasterio, classes with their colours."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.apps.maps.field_map import ARRAYS, FieldMap
from gsparc.apps.maps.geojson import write_shapes
from gsparc.base.errors import DataError
from gsparc.base.files import whole_file

NO_CLASS = 65535  # in a file of classes


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

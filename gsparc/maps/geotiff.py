"""A map as GeoTIFF, a band a layer, where its metres are about a known place on Earth."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gsparc.data.errors import DataError
from gsparc.data.files import whole_file
from gsparc.data.links.georeference import Georeference
from gsparc.maps.field_map import REFUSED, FieldMap


def wanted(asked: bool | None, origin: Georeference | None) -> bool:
    """Whether a GeoTIFF is written; None: where it can be.

    Raises:
        DataError: it is asked for, and cannot be.
    """
    there = find_spec("rasterio") is not None
    if asked and origin is None:
        raise DataError("geotiff=true: positions were in metres about an unknown origin, not in degrees")
    if asked and not there:
        raise DataError("geotiff=true: needs rasterio; pip install 'gsparc[maps]'")
    return there and origin is not None and asked is not False


def write_geotiff(path: str | Path, found: FieldMap, origin: Georeference) -> None:
    """Write float32 bands, north up; named, NaN where nothing is said.

    Bands are of the strongest station: `power_db`, `lower_db`, `upper_db`, `expected_error_db`, `sinr_db`,
    `outage`, `best_server` (number of the station), `server_chance`, and then the power of each of several
    stations. The projection is the one that `Georeference` describes, azimuthal equidistant about its place.
    """
    import rasterio
    from rasterio.transform import from_origin

    best = np.where(found.best_server == REFUSED, np.nan, found.best_server.astype(np.float32))
    bands = {name: found.strongest(getattr(found, name)) for name in ("power_db", "lower_db", "upper_db")}
    bands |= {
        "expected_error_db": found.strongest(found.expected_error_db), "sinr_db": found.sinr_db,
        "outage": found.outage, "best_server": best,
        "server_chance": found.server_chance, **found.extra,
    }  # fmt: skip
    if len(found.stations) > 1:
        bands |= {
            f"power_db {name}": power for name, power in zip(found.stations, found.power_db, strict=True)
        }
    left, _, _, high = found.grid.extent
    place = (
        f"+proj=aeqd +lat_0={origin.latitude!r} +lon_0={origin.longitude!r} +datum=WGS84 +units=m +no_defs"
    )
    profile = {
        "driver": "GTiff", "width": len(found.grid.x), "height": len(found.grid.y), "count": len(bands),
        "dtype": "float32", "crs": place, "nodata": float("nan"), "compress": "deflate", "tiled": True,
        "transform": from_origin(left, high, found.grid.step, found.grid.step),
    }  # fmt: skip
    with whole_file(path) as partial, rasterio.open(partial, "w", **profile) as file:
        for number, (name, values) in enumerate(bands.items(), 1):
            file.write(np.flipud(values).astype(np.float32), number)
            file.set_band_description(number, name)

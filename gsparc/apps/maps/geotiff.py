"""A map as files of a GIS or a globe: rasters by rasterio, classes with their colours."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring
from zipfile import ZipFile

import numpy as np
from matplotlib.image import imsave

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.field_map import ARRAYS, FieldMap
from gsparc.apps.maps.geojson import write_shapes
from gsparc.apps.maps.layers import Layer
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
    profile = raster_profile(raster.grid, count=len(bands), dtype="float32", nodata=float("nan"))
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
    profile = raster_profile(raster.grid, count=1, dtype="uint16", nodata=NO_CLASS)
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


def raster_profile(grid: Grid, **bands: Any) -> dict[str, Any]:
    """What rasterio is told of a file and its `bands`, in the projection of `Georeference`.

    Azimuthal equidistant, in which squares of the grid are squares: UTM would turn and resample
    them. Without an origin coordinates are metres.
    """
    from rasterio.transform import from_origin

    (west, _, _, north), origin = grid.extent, grid.origin
    # Without a title programs show it as "unknown".
    form = "+proj=aeqd +datum=WGS84 +lat_0={0!r} +lon_0={1!r} +title=equidistant_about_{0}_{1}"
    place = None if origin is None else form.format(origin.latitude, origin.longitude)
    return {
        "driver": "GTiff",
        "width": len(grid.x),
        "height": len(grid.y),
        "crs": place,
        **bands,
        "transform": from_origin(west, north, grid.step, grid.step),
        "compress": "deflate",
        "tiled": True,
    }


NAMESPACE = "http://www.opengis.net/kml/2.2"
DEGREES = "EPSG:4326"
OPACITY = 0.75  # of images, through which the ground is seen


def write_kmz(path: str | Path, field: FieldMap, layers: Sequence[Layer]) -> None:
    """Write layers, the first shown and the others to be switched on;
    the map must know its place on Earth.

    Cells of a grid of metres become those of one of degrees, each with the nearest's colour.
    """
    from rasterio.enums import Resampling
    from rasterio.transform import array_bounds
    from rasterio.warp import calculate_default_transform, reproject

    profile = raster_profile(field.grid)
    x_low, x_high, y_low, y_high = field.grid.extent
    to, width, height = calculate_default_transform(
        profile["crs"], DEGREES, profile["width"], profile["height"], x_low, y_low, x_high, y_high
    )
    west, south, east, north = array_bounds(height, width, to)
    box = {"north": north, "south": south, "east": east, "west": west}
    kml = Element("kml", xmlns=NAMESPACE)
    folder = SubElement(kml, "Folder")
    with whole_file(path) as partial, ZipFile(partial, "w") as archive:
        for number, layer in enumerate(layers):
            image = np.zeros((4, height, width), np.uint8)
            cells = np.moveaxis(np.flipud(_colours(layer)), 2, 0)  # images go from north to south
            reproject(
                cells,
                image,
                src_transform=profile["transform"],
                dst_transform=to,
                src_crs=profile["crs"],
                dst_crs=DEGREES,
                resampling=Resampling.nearest,
            )
            picture, file = BytesIO(), f"{number}.png"
            imsave(picture, np.ascontiguousarray(np.moveaxis(image, 0, 2)))
            archive.writestr(file, picture.getvalue())
            overlay = SubElement(folder, "GroundOverlay")
            for name, text in {
                "name": layer.name,
                "visibility": str(int(number == 0)),
                "description": _explain(layer),
            }.items():
                SubElement(overlay, name).text = text
            SubElement(SubElement(overlay, "Icon"), "href").text = file
            edges = SubElement(overlay, "LatLonBox")
            for name, degrees in box.items():
                SubElement(edges, name).text = f"{degrees:.9f}"
        archive.writestr("doc.kml", tostring(kml, encoding="utf-8", xml_declaration=True))


def _colours(layer: Layer) -> np.ndarray:
    """Colours and opacity (ny, nx, 4) uint8; nothing where nothing is said."""
    finite = np.isfinite(layer.values)
    colours = layer.legend.to_colours(layer.values)
    if layer.words:
        table = (255 * layer.table()[:, :3]).astype(np.uint8)
        colours = table[np.where(finite, layer.values, 0).astype(int)]
    return np.dstack([colours, np.where(finite, round(255 * OPACITY), 0)]).astype(np.uint8)


def _explain(layer: Layer) -> str:
    """What its colours mean, as HTML."""
    if not layer.words:
        ends = f"{layer.legend.low:.4g} to {layer.legend.high:.4g}"
        return f"{layer.legend.label}: {ends}, colours of {layer.legend.colours}"
    rows = layer.class_table()
    lines = zip(rows["colour"], rows["station"], rows["share"], strict=True)
    return "<br>".join(
        f'<font color="{c}">&#9632;</font> {name} ({share:.1%})' for c, name, share in lines
    )

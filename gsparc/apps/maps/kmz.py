"""Layers of a map as images for Google Earth: a KMZ of the OGC's KML 2.2."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring
from zipfile import ZipFile

import numpy as np
from matplotlib.image import imsave

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.geotiff import raster_profile
from gsparc.apps.maps.layers import Layer
from gsparc.base.files import whole_file

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

    profile = raster_profile(field)
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

"""Layers for Google Earth, read back as it reads them."""

from io import BytesIO
from xml.etree import ElementTree
from zipfile import ZipFile

import numpy as np
import pytest
from matplotlib.image import imread
from towns import town_on_earth

from gsparc.apps.maps.geotiff import NAMESPACE, write_kmz
from gsparc.apps.maps.layers import list_layers
from gsparc.apps.maps.making import predict_map


def test_an_image_has_each_cells_colour_where_the_cell_lies(tmp_path):
    pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'gsparc[maps]'")
    found = predict_map(town_on_earth(), step_m=2.0)
    layers = list(list_layers(found))
    write_kmz(tmp_path / "map.kmz", found, layers)
    with ZipFile(tmp_path / "map.kmz") as archive:
        told = ElementTree.fromstring(archive.read("doc.kml"))
        drawn = [f"{{{NAMESPACE}}}{name}" for name in ("Folder", "GroundOverlay")]
        overlays = told.findall("/".join(drawn))
        images = [imread(BytesIO(archive.read(f"{k}.png"))) for k in range(len(overlays))]
    text = [{part.tag.split("}")[1]: part.text for part in one.iter()} for one in overlays]
    assert [one["name"] for one in text] == [layer.name for layer in layers]
    assert [one["visibility"] for one in text] == ["1"] + ["0"] * (len(layers) - 1)
    index = [layer.name for layer in layers].index("best_server")
    layer, edges = layers[index], ("north", "south", "east", "west")
    box = {name: float(text[index][name]) for name in edges}
    cell = np.flatnonzero(np.isfinite(layer.values))
    north, east = found.grid.origin.to_degrees(found.grid.places(cell)[:, :2])
    tall, wide = images[index].shape[:2]
    row = ((box["north"] - north) / (box["north"] - box["south"]) * tall).astype(int)
    column = ((east - box["west"]) / (box["east"] - box["west"]) * wide).astype(int)
    seen = images[index][row, column]
    own = layer.table()[layer.values.reshape(-1)[cell].astype(int), :3]
    assert len(np.unique(own, axis=0)) == 2 and (seen[:, 3] > 0.7).all()
    assert (np.abs(seen[:, :3] - own).max(1) < 0.01).mean() > 0.98  # a border goes either way
    assert "&#9632;" in text[index]["description"] and "%" in text[index]["description"]
    assert "[dB]" in text[0]["description"]

"""A GeoTIFF lies at the right place on Earth."""

from __future__ import annotations

import numpy as np
import pytest
from towns import town_model

import gsparc
from gsparc.data.errors import DataError
from gsparc.data.links.georeference import Georeference
from gsparc.maps.geotiff import wanted, write_geotiff

ORIGIN = Georeference(47.2, 11.3)


def test_read_back_at_the_right_place(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'gsparc[maps]'")
    from rasterio.warp import transform

    found = gsparc.load(town_model()).map([0, 0, 80, 60], step_m=4.0)
    write_geotiff(tmp_path / "map.tif", found, ORIGIN)
    with rasterio.open(tmp_path / "map.tif") as file:
        assert file.descriptions[0] == "power_db" and file.count == 10
        for row, column in ((0, 0), (14, 19), (7, 3)):
            x, y = file.xy(len(found.grid.y) - 1 - row, column)
            longitude, latitude = transform(file.crs, "EPSG:4326", [x], [y])
            place = np.array([[found.grid.x[column], found.grid.y[row]]])
            expected = ORIGIN.to_degrees(place)
            assert np.allclose([latitude[0], longitude[0]], np.ravel(expected), atol=1e-7)
            (value,) = next(file.sample([(x, y)], indexes=1))
            assert value == pytest.approx(found.strongest(found.power_db)[row, column])


def test_asked_for_without_a_place_on_earth():
    with pytest.raises(DataError, match="unknown origin"):
        wanted(True, None)
    assert not wanted(None, None) and not wanted(False, ORIGIN)

"""A GeoTIFF lies at the right place on Earth."""

import json

import numpy as np
import pytest
from towns import ORIGIN, town_model, town_on_earth

import gsparc
from gsparc.apps.maps import predict_map
from gsparc.apps.maps.geotiff import NO_CLASS, check_geotiff, write_classes, write_geotiff
from gsparc.apps.maps.planning import plan_measurements
from gsparc.base.errors import DataError


def test_a_polygon_in_degrees_comes_back_as_the_same_cells(tmp_path):
    """Drawn in degrees with heights and a hole;
    rasterio masks the file's cells by the same polygon.
    """
    pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'gsparc[maps]'")
    import rasterio
    from rasterio.features import geometry_mask
    from rasterio.warp import transform_geom

    predictor = town_on_earth()
    rings = [
        [[5, 5], [75, 10], [60, 55], [10, 50], [5, 5]],
        [[30, 20], [50, 20], [40, 40], [30, 20]],
    ]
    degrees = [
        np.stack([*ORIGIN.to_degrees(np.array(ring, float))[::-1], np.full(len(ring), 570.0)], 1)
        for ring in rings
    ]
    drawn = {"type": "Polygon", "coordinates": [ring.tolist() for ring in degrees]}
    (tmp_path / "area.geojson").write_text(json.dumps({"type": "Feature", "geometry": drawn}))
    found = predict_map(predictor, tmp_path / "area.geojson", step_m=1.0)
    write_geotiff(tmp_path / "map.tif", found)
    with rasterio.open(tmp_path / "map.tif") as file:
        assert file.descriptions[0] == "power_db" and file.count == 12
        units = dict(zip(file.descriptions, file.units, strict=True))
        assert units["upper_db"] == found.unit and units["sinr_db"] == "dB" and not units["outage"]
        power = file.read(1)
        outside = geometry_mask(
            [transform_geom("EPSG:4326", file.crs, drawn)], file.shape, file.transform
        )
    assert (np.isnan(power) == outside).mean() > 0.999  # centres on an edge go either way
    np.testing.assert_array_equal(np.flipud(power), found.at_best_server(found.power_db))


def test_a_file_for_other_programs_said_neither_unit_nor_colours(tmp_path):
    """Servers were float32 without a table of colours; unit, threshold and height stood nowhere."""
    pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'gsparc[maps]'")
    import rasterio

    found = predict_map(town_on_earth(), step_m=4.0, threshold_db=-70)
    colours = np.linspace(0, 1, 3 * len(found.stations)).reshape(-1, 3)
    number = found.layer("best_server")
    write_geotiff(tmp_path / "map.tif", found)
    write_classes(tmp_path / "best.tif", found, number, found.stations, colours)
    with rasterio.open(tmp_path / "map.tif") as file:
        tags = file.tags()
        assert (tags["unit"], tags["threshold_db"]) == ("dB", "-70.0")
        assert file.crs.to_wkt().startswith('PROJCS["equidistant_about_47.2_11.3"')  # was "unknown"
    with rasterio.open(tmp_path / "best.tif") as file:
        assert file.dtypes == ("uint16",) and file.colormap(1)[1][:3] == tuple(
            (255 * colours[1]).astype(int)
        )
        np.testing.assert_array_equal(np.flipud(file.read(1)), np.nan_to_num(number, nan=NO_CLASS))


def test_polygons_of_best_servers_had_no_names(tmp_path):
    """`rio shapes` left numbers of best_server.csv, to be joined by hand."""
    pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'gsparc[maps]'")
    from shapely import contains_xy
    from shapely.geometry import shape

    found = predict_map(town_on_earth(), step_m=4.0)
    number = found.layer("best_server")
    write_classes(tmp_path / "best_server.tif", found, number, found.stations, np.zeros((2, 3)))
    told = json.loads((tmp_path / "best_server.geojson").read_text())["features"]
    areas = [(shape(one["geometry"]), tuple(one["properties"].values())) for one in told]
    cell = np.flatnonzero(np.isfinite(number))
    north, east = ORIGIN.to_degrees(found.grid.places(cell)[:, :2])
    for k in range(2):
        inside = np.any(
            [
                contains_xy(area, east, north)
                for area, one in areas
                if one == (k, found.stations[k])
            ],
            axis=0,
        )
        np.testing.assert_array_equal(inside, number.reshape(-1)[cell] == k)


def test_degrees_for_a_model_in_metres_were_a_speck_of_its_map(tmp_path):
    ring = [[11.3, 47.2], [11.301, 47.2], [11.301, 47.2008], [11.3, 47.2]]
    (tmp_path / "area.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    predictor = gsparc.load(town_model())
    with pytest.raises(DataError, match="degrees mean nothing to"):
        predict_map(predictor, tmp_path / "area.geojson")
    with pytest.raises(DataError, match="degrees mean nothing to"):
        plan_measurements(predictor, 3, walkable=tmp_path / "area.geojson")
    with pytest.raises(DataError, match="a rectangle is in metres"):
        predict_map(predictor, [11.3, 47.2, 11.301, 47.2008])


def test_asked_for_without_rasterio(monkeypatch):
    monkeypatch.setattr("gsparc.apps.maps.geotiff.find_spec", lambda name: None)
    with pytest.raises(DataError, match="needs rasterio"):
        check_geotiff(True)
    assert not check_geotiff(None) and not check_geotiff(False)

"""Maps of planning tools in several formats: the same levels, and what a format does not state."""

import numpy as np
import pytest
from PIL import Image

import gsparc
from gsparc.base.errors import DataError
from gsparc.data.georeference import Georeference
from gsparc.datasets.prior_levels import read_prior_levels, read_prior_maps
from gsparc.datasets.rasters import read_raster
from gsparc.tables.own import from_arrays

rasterio = pytest.importorskip("rasterio", reason="pip install 'gsparc[maps]'")
from rasterio import shutil  # noqa: E402
from rasterio.transform import from_origin  # noqa: E402

HERE, ZONE, SIDE = (35.98, -78.99), "EPSG:32617", (40, 30)
LIST = {"crs": ZONE, "nodata": -9999}
SAID = {".tif": {}, ".bil": {}, ".asc": {}, ".txt": LIST, ".csv": LIST}
WRITERS = {".bil": ("EHdr", {}), ".asc": ("AAIGrid", {"DECIMAL_PRECISION": 6}), ".txt": ("XYZ", {})}
WRITERS[".csv"] = ("XYZ", {"COLUMN_SEPARATOR": ",", "ADD_HEADER_LINE": "YES"})


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """One map of levels to a hundredth of a decibel, two of its squares without one."""
    folder = tmp_path_factory.mktemp("maps")
    level = np.random.default_rng(0).uniform(-120, -40, SIDE).round(2).astype(np.float32)
    level[3, 4] = level[20, 11] = -9999
    size = {"height": SIDE[0], "width": SIDE[1], "count": 1, "dtype": "float32", "nodata": -9999}
    at = from_origin(681_000, 3_984_000, 10, 10)
    with rasterio.open(folder / "a.tif", "w", crs=ZONE, transform=at, **size) as file:
        file.write(level, 1)
    for suffix, (driver, options) in WRITERS.items():
        shutil.copy(folder / "a.tif", folder / f"a{suffix}", driver=driver, **options)
    return folder


def rows(count=12):
    """Places inside the map, in degrees."""
    raster = Georeference(*HERE)
    east, north = np.random.default_rng(1).uniform(50, 250, (2, count))
    from rasterio.warp import transform

    degrees = transform(ZONE, "EPSG:4326", 681_000 + east, 3_983_600 + north)
    latitude, longitude = np.array(degrees[1]), np.array(degrees[0])
    still = raster.to_degrees(np.array([[0.0, 0.0]]))
    return from_arrays(
        {
            "latitude": latitude,
            "longitude": longitude,
            "rx_height": np.array(1.5),
            "station_latitude": still[0],
            "station_longitude": still[1],
            "station_height": np.array(30.0),
            "station": np.zeros(count, int),
            "rssi_db": np.linspace(-90, -60, count),
        }
    )


def test_formats_of_one_map_have_the_same_levels(files):
    data, known = rows(), read_prior_levels(files / "a.tif", rows())
    assert len(known[1]) == SIDE[0] * SIDE[1] - 2
    differences = {}
    for suffix, said in SAID.items():
        places, level = read_prior_levels({"file": files / f"a{suffix}", **said}, data)
        assert np.allclose(places, known[0], atol=1e-3), suffix
        differences[suffix] = float(np.abs(level - known[1]).max())
    assert max(differences.values()) == 0.0, differences


def test_a_list_asks_for_its_projection_and_its_mark(files, refused):
    asks = "states no projection and no mark of what is absent; say both"
    for suffix in (".txt", ".csv"):
        refused(asks, read_prior_levels, files / f"a{suffix}", rows())
    refused(asks, read_raster, files / "a.txt", crs=ZONE)
    wrong = {"file": files / "a.txt", "crs": "EPSG:1", "nodata": "none"}
    refused("no such projection", read_prior_levels, wrong, rows())
    odd = {"file": files / "a.txt", "crs": ZONE, "nodata": "nine"}
    refused("a.txt: no raster", read_prior_levels, odd, rows())
    refused("takes file, crs, nodata, legend", read_prior_levels, {"map": "a.tif"}, rows())
    assert np.nanmin(read_raster(files / "a.txt", ZONE, "none").bands) == -9999


def test_a_damaged_grid_is_refused_in_one_line(tmp_path, refused):
    (tmp_path / "a.asc").write_text("ncols 3\nnrows x\n1 2 3\n")
    refused("a.asc: no raster", read_raster, tmp_path / "a.asc")


COLOURS = [(255, 0, 0), (255, 255, 0), (0, 0, 255)]
LEGEND = [f"{bytes(c).hex()}={db}" for c, db in zip(COLOURS, (-70, -80, -90), strict=True)]
KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><GroundOverlay><Icon><href>a.png</href></Icon>
<LatLonBox><north>35.984</north><south>35.98</south><east>-78.985</east><west>-78.995</west>{}</LatLonBox>
</GroundOverlay></kml>"""


def test_an_overlay_is_read_by_its_legend_alone(tmp_path, refused):
    level = np.linspace(-70, -90, 41)
    truth = [np.interp(level, [-90, -80, -70], [c[k] for c in COLOURS[::-1]]) for k in range(3)]
    shades = np.c_[np.array(truth).T.round(), np.full(41, 255)].astype(np.uint8)
    shades = np.r_[shades, [[255, 0, 0, 0], [0, 255, 0, 255]]].astype(np.uint8)  # clear, foreign
    Image.fromarray(np.stack([shades, shades])).save(tmp_path / "a.png")
    (path := tmp_path / "a.kml").write_text(KML.format(""))
    refused("colours, not levels; state what they mean", read_raster, path)
    for few in (LEGEND[:1], ["red=-70", "blue=-90"]):
        refused("two colours at least like ff0000=-70", read_raster, path, legend=few)
    raster = read_raster(path, legend=LEGEND)
    told = raster.bands[0].reshape(2, -1)[1]
    assert np.isnan(told[41:]).all() and np.nanmax(np.abs(told[:41] - level)) <= 5
    assert np.isfinite(told[:41]).all()
    assert raster.points[0].tolist() == pytest.approx([-78.995 + 0.005 / 43, 35.983])
    places, levels = read_prior_levels({"file": str(path), "legend": LEGEND}, rows())
    assert {*levels} == {-70, -80, -90} and len(places) == len(levels)
    path.write_text(KML.format("<rotation>30</rotation>"))
    refused("no ground overlay", read_raster, path, legend=LEGEND)
    path.write_text(KML.format("")[:-20])
    refused("no ground overlay", read_raster, path, legend=LEGEND)


def test_a_projection_of_measurements_without_a_place(files, refused):
    at = np.c_[np.random.default_rng(0).uniform(0, 99, (9, 2)), np.full(9, 1.5)]
    data = from_arrays({"rx_position": at, "tx_position": np.zeros(3), "rssi_db": at[:, 0]})
    refused("which the measurements do not state", read_prior_levels, files / "a.bil", data)
    local = {"file": files / "a.txt", "crs": "local", "nodata": -9999}
    with pytest.raises(DataError, match="all rows lie elsewhere"):
        read_prior_levels(local, data)


def hills(path, crests=(350.0,), height=60.0, side=1000.0, step=20.0):
    """Heights [m] of ridges along y, in metres of the measurements."""
    axis = np.arange(step / 2, side, step)
    ground = sum(height * np.exp(-(((axis - crest) / 40) ** 2)) for crest in crests)
    size = {"height": len(axis), "width": len(axis), "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", transform=from_origin(0, side, step, step), **size) as file:
        file.write(np.tile(ground, (len(axis), 1)).astype(np.float32), 1)
    return str(path)


def test_a_terrain_shadows_what_lies_behind_its_hills(tmp_path, refused, monkeypatch):
    pytest.importorskip("itmlogic", reason="pip install 'gsparc[itm]'")
    at = np.c_[np.random.default_rng(0).uniform(50, 950, (30, 2)), np.full(30, 1.5)]
    post = {"tx_position": np.array([20.0, 500.0, 15.0]), "rssi_db": np.linspace(-90, -60, 30)}
    data = from_arrays({"rx_position": at, **post, "carrier_hz": np.array(8e8)})
    dem, flat = hills(tmp_path / "dem.tif"), hills(tmp_path / "flat.tif", ())
    places, level = read_prior_levels(f"itm:{dem}", data)
    open_ground = read_prior_levels({"itm": flat, "mhz": 800}, data)[1]
    behind = places[:, 0] > 420
    shadow = open_ground - level
    assert shadow[behind].mean() > 12 and np.abs(shadow[places[:, 0] < 250]).mean() < 8
    higher = read_prior_levels({"itm": dem, "tx_m": 200.0}, data)[1]
    assert (higher - level)[behind].mean() > 5
    silent = from_arrays({"rx_position": at, **post})
    refused("the carrier are needed", read_prior_levels, f"itm:{dem}", silent)
    assert len(read_prior_levels({"itm": dem, "mhz": 800}, silent)[1]) == len(level)
    far = from_arrays({"rx_position": at + 1e5, **post, "carrier_hz": np.array(8e8)})
    refused("no height is known about the rows", read_prior_levels, f"itm:{dem}", far)
    monkeypatch.setitem(__import__("sys").modules, "itmlogic.preparatory_subroutines.qlrpfl", None)
    refused(r"needs itmlogic; pip install 'gsparc\[itm\]'", read_prior_levels, f"itm:{dem}", data)


def test_each_station_of_a_network_has_its_own_shadow(tmp_path):
    """Antennas on the ground, of which the model takes logarithms, and a mast of no known place."""
    pytest.importorskip("itmlogic", reason="pip install 'gsparc[itm]'")
    at = np.c_[np.random.default_rng(0).uniform(50, 950, (30, 2)), np.zeros(30)]
    masts = np.array([[20.0, 500, 0], [980, 500, 0], [np.nan, np.nan, np.nan]])
    network = {"station_position": masts, "station": np.arange(30) % 3, "carrier_hz": np.array(8e8)}
    data = from_arrays({"rx_position": at, "rssi_db": np.linspace(-90, -60, 30), **network})
    dem, shown = hills(tmp_path / "dem.tif"), data.site.every_station.shown
    (_, _, (places, west)), (_, _, (_, east)) = read_prior_maps(f"itm:{dem}", data, shown)
    behind = places[:, 0] > 420
    assert (east - west)[behind].mean() > 10 > (east - west)[~behind].mean()


def test_a_terrain_is_a_prior_of_a_fit(tmp_path):
    pytest.importorskip("itmlogic", reason="pip install 'gsparc[itm]'")
    at = np.c_[np.random.default_rng(0).uniform(50, 950, (20, 2)), np.full(20, 1.5)]
    settings = {"prior": {"itm": hills(tmp_path / "dem.tif"), "mhz": 800.0}}
    levels = {"tx": [20.0, 500.0, 15.0], "rssi": np.where(at[:, 0] > 350, -110.0, -70.0)}
    model = gsparc.fit(rx=at, **levels, settings=settings, save=tmp_path / "model.ckpt")
    again = gsparc.load(tmp_path / "model.ckpt")
    assert np.array_equal(again.rssi(rx=at), model.rssi(rx=at))

"""A map from before any row: it helps where it is right, and is left out where it is not."""

import re

import numpy as np
import pytest
import rasterio
import torch
from networks import draw_network
from rasterio.transform import from_origin
from refusals import refused

import gsparc
from gsparc.datasets.prior_levels import read_prior_levels
from gsparc.models.mixture.methods import Powers
from gsparc.models.powers.prior_map import NetworkMaps, PriorMap, describe_use
from gsparc.models.powers.together.network import find_sectors
from gsparc.models.powers.together.terms import rows_of_stations
from gsparc.processes.sectors import NO_AZIMUTH
from gsparc.tables.own import from_arrays

POST = [0.0, 0.0, 20.0]
AXIS = np.arange(5.0, 700, 10)  # centres of squares


def smooth(places, seed, length=60.0, waves=60):
    rng = np.random.default_rng(seed)
    wave, phase = rng.normal(size=(waves, 2)) * 1.4 / length, rng.uniform(0, 2 * np.pi, waves)
    return np.sqrt(2 / waves) * np.cos(places[:, :2] @ wave.T + phase).sum(1)


def planned(places, town=1):
    """What a planning tool knows: distance, and the shadows of buildings."""
    return -40 - 30 * np.log10(np.hypot(*places[:, :2].T) + 10) + 8 * smooth(places, town)


def draw(count, seed):
    return np.c_[np.random.default_rng(seed).uniform(50, 650, (count, 2)), np.full(count, 1.5)]


def measured(places, seed=0):
    rng = np.random.default_rng(seed)
    return planned(places) + 3 * smooth(places, 2, 30.0) + 6 + rng.normal(0, 1, len(places))


def write_raster(path, levels, step=10.0, stored=np.float64, names=(), width=None, low=0.0, **tags):
    """A GeoTIFF with a band of levels (M,) [dB] each, on squares of `step` [m] from `low`."""
    side = round(len(levels[0]) ** 0.5)
    bands = np.reshape(levels, (-1, side, side))[:, ::-1, :width].astype(stored)
    how = {"driver": "GTiff", "nodata": tags.pop("nodata", None), "dtype": bands.dtype.name}
    how |= dict(zip(("count", "height", "width"), bands.shape, strict=True))
    at = from_origin(low, low + side * step, step, step)
    with rasterio.open(path, "w", transform=at, **how) as file:
        file.write(bands)
        file.descriptions = [*names, *[""] * (len(bands) - len(names))]
        for tag, value in tags.items():
            setattr(file, tag, [value] * len(bands))
    return path


@pytest.fixture
def rasters(tmp_path):
    """Files of the town, of another town, and of two stations."""
    for name, towns in (("right", (1,)), ("wrong", (7,)), ("two", (7, 1))):
        bands = [f"power_db {station}" for station in "ba"] if name == "two" else ()
        write_raster(tmp_path / f"{name}.tif", [planned(SQUARES, t) for t in towns], names=bands)
    return tmp_path


SQUARES = np.stack(np.meshgrid(AXIS, AXIS), -1).reshape(-1, 2)
FAR = SQUARES[:, 0] > 500


def data_of(rows):
    return from_arrays(
        {"rx_position": rows, "tx_position": np.array(POST), "rssi_db": measured(rows)}
    )


def miss(model, asked):
    return float(np.sqrt(np.mean((model.rssi(rx=asked)[:, 0] - measured(asked, 1)) ** 2)))


def fit(rows, prior=None, **more):
    settings = {} if prior is None else {"prior": prior}
    return gsparc.fit(
        **{"rx": rows, "tx": POST, "rssi": measured(rows), "settings": settings, **more}
    )


@pytest.mark.parametrize("count", [10, 40])
def test_a_map_helps_where_it_is_right_and_is_left_out_where_it_is_not(rasters, count):
    rows, asked = draw(count, 103), draw(400, 4)
    found = [fit(rows, one and rasters / f"{one}.tif") for one in (None, "right", "wrong")]
    error = [miss(model, asked) for model in found]
    assert error[1] < 0.7 * error[0] and error[2] < 1.05 * error[0], error


@pytest.mark.parametrize(
    "stored",
    [{"scales": 0.01, "stored": "int16"}, {"offsets": 200.0}, {"units": "dBW"}, {"units": "mW"}],
    ids=["scale", "offset", "dBW", "mW"],
)
def test_a_raster_is_read_by_its_own_scale_offset_and_unit(tmp_path, stored):
    """Tags of bands were not read: levels a hundred times as large, and milliwatts,
    were taken for levels.
    """
    level = planned(SQUARES)
    kept = {"dBW": level - 30, "mW": 10 ** (level / 10)}.get(stored.get("units"), level)
    kept = (kept - stored.get("offsets", 0.0)) / stored.get("scales", 1.0)
    data = data_of(draw(30, 3))
    found = read_prior_levels(write_raster(tmp_path / "map.tif", [kept], **stored), data)[1]
    np.testing.assert_allclose(np.sort(found), np.sort(level), atol=0.01)
    height = write_raster(tmp_path / "height.tif", [level], units="m")
    refused("its unit is m; levels are needed", read_prior_levels, height, data)


@pytest.mark.parametrize("mark", [-9999.0, 1e30, 0.0, -200.0])
def test_marks_that_no_tag_names_are_no_levels(tmp_path, mark, caplog):
    """-9999 of 1,400 of 4,900 squares made a map worthless, 1e30 was refused as an own term."""
    rows, asked = draw(40, 103), draw(400, 4)
    level, files = planned(SQUARES), {}
    for name, nodata in (("untagged", None), ("tagged", mark)):
        marked = [np.where(FAR, mark, level)]
        files[name] = write_raster(tmp_path / f"{name}.tif", marked, nodata=nodata)
    error = [miss(fit(rows, one), asked) for one in files.values()]
    assert error[0] == pytest.approx(error[1]) and error[0] < 0.8 * miss(fit(rows), asked)
    assert caplog.text.count("1400 levels are") == 1 and "untagged.tif" in caplog.text


def test_outside_the_area_of_a_map_it_is_its_own_law_of_distance(tmp_path):
    """Half of the town had the levels of the other half's edge, and was worse than no map."""
    rows, asked = draw(40, 103), draw(400, 4)
    assert miss(
        fit(rows, write_raster(tmp_path / "half.tif", [planned(SQUARES)], width=35)), asked
    ) < 0.95 * miss(fit(rows), asked)
    still, inner = np.array(POST), SQUARES[SQUARES[:, 0] < 350]
    found = PriorMap.from_levels(inner, -30 * np.log10(np.linalg.norm(inner, axis=1)), still)
    at = torch.tensor(
        [[300.0, 300.0, 1], [600.0, 300.0, 1]], dtype=torch.float64, requires_grad=True
    )
    near, far = found.columns(at)[:, 0]
    assert float(near - far) == pytest.approx(
        30 * np.log10(600**2 + 300**2) / 2 - 30 * np.log10(300 * 2**0.5), abs=0.1
    )
    assert torch.autograd.grad(far, at)[0][1, 0] < 0


@pytest.mark.parametrize(
    "levels, says",
    [
        (lambda level: -level, "path losses. write minus them, or scale -1"),
        (lambda level: 10 ** (level / 10), "linear powers. write 10 log10 of them, or the unit"),
        (lambda level: level / 10, "in another unit, or of another place"),
    ],
    ids=["losses", "milliwatts", "tenths"],
)
def test_a_map_whose_levels_rise_otherwise_than_rows_is_said(tmp_path, caplog, levels, says):
    rows = draw(40, 103)
    model = fit(rows, write_raster(tmp_path / "map.tif", [levels(planned(SQUARES))]))
    warned = [one.message for one in caplog.records if one.levelname == "WARNING"]
    assert any(re.search(says, text) for text in warned)
    assert miss(model, draw(400, 4)) < 1.01 * miss(fit(rows), draw(400, 4))
    caplog.clear()
    fit(rows, write_raster(tmp_path / "map.tif", [planned(SQUARES)]))
    assert "model.prior" not in caplog.text


def test_a_map_that_does_not_pay_at_rows_left_out_is_said_and_leaves_nothing_behind(
    rasters, caplog
):
    """Kernels were those of a map that was left out, and nobody said that it was."""
    rows, asked = draw(40, 103), draw(50, 4)
    found = fit(rows, rasters / "wrong.tif").rssi(rx=asked)
    assert "the map is left out: rows left out are predicted as well without it" in caplog.text
    np.testing.assert_allclose(found, fit(rows).rssi(rx=asked), atol=1e-4)


def test_a_band_of_a_station_s_name_is_found_where_the_station_stands_alone(tmp_path, caplog):
    """The first band was taken, of whatever name, and a table of one station had no name."""
    rows, level = draw(40, 103), planned(SQUARES)
    one = {"tx": None, "station_position": np.array([POST]), "rssi": measured(rows)[:, None]}
    for names in (("b", "a"), ("power_db b", "power_db a")):
        path = write_raster(tmp_path / "two.tif", [planned(SQUARES, 7), level], names=names)
        caplog.clear()
        fit(rows, path, station_name=["a"], **one)
        assert "left out" not in caplog.text
        refused(r"two\.tif: of b, a, not of c", fit, rows, path, station_name=["c"], **one)
    fit(rows, write_raster(tmp_path / "two.tif", [level, level], names=("rsrp", "sinr")))
    assert "the first of its bands rsrp, sinr is taken" in caplog.text


def test_of_a_large_map_what_lies_about_the_rows_is_kept(tmp_path):
    land = np.random.default_rng(0).normal(-90, 5, (1, 1200 * 1200))
    path = write_raster(tmp_path / "land.tif", land, 50.0, "float32", low=-30_000)
    points, level = read_prior_levels(path, data_of(draw(30, 3)))
    assert len(level) < 40**2 and points.min() > -650 and points.max() < 1350


def test_each_station_has_the_band_of_its_name(rasters, caplog):
    rows = draw(12, 103)
    both = {"rssi": np.c_[measured(rows), measured(rows)], "tx": None, "station_name": ["a", "c"]}
    posts = {"station_position": np.array([POST, POST])}
    refused(r"prior=.*two\.tif: of b, a, not of c", fit, rows, rasters / "two.tif", **both, **posts)
    found = fit(rows, rasters / "two.tif", **{**both, "station_name": ["a", "b"]}, **posts)
    own = [
        any(isinstance(one.term, PriorMap) for one in copy.member.trend.more)
        for _, copy in found.method
    ]
    assert own == [True, False]  # what was measured is of the town in a's band


def test_places_and_powers_of_a_table_are_a_map_too(tmp_path, caplog):
    caplog.set_level("INFO")
    rows, known = draw(12, 103), draw(2000, 5)
    table = np.c_[known[:, :2], planned(known)]
    np.savetxt(tmp_path / "plan.csv", table, delimiter=",", header="x_m,y_m,rsrp_dbm", comments="")
    fit(rows, tmp_path / "plan.csv")
    assert "a share of the map" in caplog.text


def test_levels_between_points_are_those_of_the_nearest_and_have_slopes():
    corners = np.array([[0.0, 0], [10, 0], [0, 10], [10, 10]])
    found = PriorMap.from_levels(corners, np.array([0.0, 4, 8, 12]), np.full(3, np.nan))
    at = torch.tensor([[0.0, 0, 1], [5, 5, 1]], dtype=torch.float64, requires_grad=True)
    level = found.columns(at)[:, 0]
    assert level.tolist() == pytest.approx([-6, 0], abs=1e-3)
    assert torch.autograd.grad(level.sum(), at)[0][1, 1] > 0


def test_maps_that_cannot_be_meant_are_refused(rasters):
    rows, path = draw(30, 3), rasters / "right.tif"
    refused(r"model\.prior=none\.tif: no such file", fit, rows, "none.tif")
    refused(r"draw it first, gsparc map ckpt=a\.ckpt", fit, rows, "a.ckpt")
    far = rows + np.array([5000.0, 0, 0])
    refused(
        r"it is of x 5 to 695, .* all rows lie elsewhere: x 5\d\d\d",
        fit,
        far,
        path,
        rssi=measured(rows),
    )
    channels = {"rssi": None, "csi": np.ones(30) + 0j, "frequency_hz": 1e9}
    refused(r"model\.prior is of received powers", fit, rows, path, **channels)


def test_a_map_of_one_end_means_nothing_where_both_move(rasters, caplog):
    caplog.set_level("INFO")
    rows = draw(30, 3)
    fit(rows, rasters / "right.tif", tx=draw(30, 9))
    assert "noise" in caplog.text  # settings are told of
    assert "a share of the map" not in caplog.text


def network_rasters(path, level, names):
    """A raster of each cell of a network."""
    named = [name and f"power_db {name}" for name in names]
    return write_raster(path, level.T[: len(names)], 125.0, names=named)


NET_AXIS = np.arange(62.5, 2500, 125)
NET_SQUARES = np.stack(np.meshgrid(NET_AXIS, NET_AXIS), -1).reshape(-1, 2)


def test_a_network_has_a_map_of_a_cell_or_of_a_site(tmp_path):
    one = draw_network(1, 0, 60, NET_SQUARES)
    data, path = one.data(6), network_rasters(tmp_path / "two.tif", one.truth, ["0-0", "1"])
    found = NetworkMaps.from_file(path, data)
    assert [one[:2] for one in found.maps] == [(0, True), (3, False), (4, False), (5, False)]
    assert found.maps[0][2].points is found.maps[3][2].points
    network = find_sectors(data)
    under = found.put_under(network, data.site.stations.position)
    assert under.table[0, 0] == NO_AZIMUTH and torch.equal(under.table[1:], network.table[1:])
    at = torch.tensor([[1000.0, 900, 1.5]]) - torch.from_numpy(data.site.origin)
    still = torch.from_numpy(data.site.stations.position)
    places = [
        torch.cat([at[0], still[t], torch.tensor([float(t)])])[None].double() for t in range(4)
    ]
    known = [float(under.known_mean(place)) for place in places]
    far = [float((place[0, :3] - place[0, 3:6]).norm()) for place in places]
    level = float(found.maps[1][2].columns(at)[0, 0])
    assert known[1] == known[2] == 0  # of cells without a map
    assert known[3] + under.more[0].level - 35 * np.log10(far[3]) == pytest.approx(level)
    named = network_rasters(tmp_path / "none.tif", one.truth, ["x", "y"])
    refused("of x, y, not of", NetworkMaps.from_file, named, data)
    assert Powers(prior=path).why_not(data) is None
    both = {
        "rx_position": draw(4, 1),
        "station_position": [POST, POST],
        "rssi_db": np.full((4, 2), -60.0),
    }
    assert "say stations=each" in Powers(prior=path).why_not(from_arrays(both))


def network_table(path, level, heads):
    """A table of places, and of levels of a cell in each column."""
    table, named = np.c_[NET_SQUARES, level[:, : len(heads)]], ",".join(["x_m", "y_m", *heads])
    np.savetxt(path, table, delimiter=",", header=named, comments="")
    return path


@pytest.fixture(scope="module")
def by_pci():
    """A network whose drive speaks of PCIs, and whose list of names, and its levels."""
    one = draw_network(1, 0, 60, NET_SQUARES)
    labels = [f"{t // 3}-{t % 3}" for t in range(30)]
    names = {
        "station_label": np.array(labels),
        "station_name": np.array([f"{300 + t}" for t in range(30)]),
    }
    return from_arrays(one.arrays(6) | names), one.truth


@pytest.mark.parametrize("head", ["{0}-{1}", "{0}-{1} [dBm]", "{2}", "RSRP {2}", "PCI {2}"])
def test_a_wide_table_of_a_map_lost_cells_and_was_not_read_by_pci(tmp_path, by_pci, head, caplog):
    data, level = by_pci
    heads = [head.format(t // 3, t % 3, 300 + t) for t in range(30)]
    found = NetworkMaps.from_file(network_table(tmp_path / "wide.csv", level, heads), data)
    # A map of a cell has its pattern: as `0-1 (301)` it was taken for one of the whole site.
    assert [one[:2] for one in found.maps] == [(t, True) for t in range(30)]
    known = found.maps[7][2].level.numpy()
    np.testing.assert_allclose(known - known.mean(), level[:, 7] - level[:, 7].mean(), atol=1e-3)
    assert not caplog.text


def test_a_network_s_map_that_falls_where_levels_rise_is_said_by_station(by_pci, tmp_path):
    data, level = by_pci
    cells, names = [f"{t // 3}-{t % 3}" for t in range(30)], data.site.every_station.shown
    said = []
    for sign in (1, -1):
        maps = NetworkMaps.from_file(
            network_rasters(tmp_path / "all.tif", sign * level, cells), data
        )
        rows = rows_of_stations(data, np.arange(len(data)), data.site.stations.position)
        said.append(maps.explain_misfits(rows, names))
    assert not any("losses" in text for text in said[0]) and any(
        "path losses" in text for text in said[1]
    )
    assert len(said[1]) <= 6  # of 30 stations, of which some were hardly heard


def test_cells_without_a_map_and_columns_of_no_cell_are_warned_of(tmp_path, by_pci, caplog):
    data, level = by_pci
    heads = ["0-0", *[f"0-{t} [dBm]" for t in range(1, 3)], "9-7 [dBm]"]
    found = NetworkMaps.from_file(network_table(tmp_path / "few.csv", level, heads), data)
    assert [number for number, *_ in found.maps] == [0, 1, 2]
    assert "no map of 1-0 (303), 1-1 (304)" in caplog.text
    assert "columns '9-7 [dBm]' are of no station that was measured" in caplog.text
    one = NetworkMaps.from_file(network_table(tmp_path / "one.csv", level, ["304"]), data)
    assert [number for number, *_ in one.maps] == [4]


def test_one_map_without_a_name_was_taken_for_that_of_every_cell(tmp_path, rasters, by_pci):
    data, level = by_pci
    refused(
        r"one map of no station's name, .* best server .*power_db NAME",
        NetworkMaps.from_file,
        network_rasters(tmp_path / "best.tif", level, [""]),
        data,
    )
    rows = draw(12, 103)
    both = {"rssi": np.c_[measured(rows), measured(rows)], "tx": None, "station_name": ["a", "c"]}
    posts = {"station_position": np.array([POST, POST])}
    refused("one map of no station's name", fit, rows, rasters / "right.tif", **both, **posts)
    foreign = network_table(tmp_path / "foreign.csv", level, ["X1 [dBm]", "X2 [dBm]"])
    refused("of X1, X2, not of 0-0 .300., .* call bands", NetworkMaps.from_file, foreign, data)


def test_several_files_were_no_path_and_bands_of_stations_names_no_maps(tmp_path, by_pci):
    """`TypeError: expected str`, and a folder of maps did not exist."""
    data, level = by_pci
    files = [str(network_rasters(tmp_path / f"0-{t}.tif", level[:, [t]], [""])) for t in range(3)]
    network_rasters(tmp_path / "best.tif", level, [""])
    for prior in (files, tmp_path):
        found = NetworkMaps.from_file(prior, data)
        assert [one[:2] for one in found.maps] == [(t, True) for t in range(3)]
        np.testing.assert_allclose(np.ptp(found.maps[2][2].level), np.ptp(level[:, 2]))
    with rasterio.open(files[0], "r+") as file:
        file.descriptions = ["0-1"]
    (found,) = NetworkMaps.from_file(files[0], data).maps
    assert found[:2] == (1, True)
    refused("none.tif: no such file", NetworkMaps.from_file, [*files, "none.tif"], data)


@pytest.mark.slow
def test_maps_of_a_networks_cells_help_and_those_of_another_do_not(tmp_path, caplog):
    caplog.set_level("INFO")
    asked = np.random.default_rng(0).uniform(0, 2500, (100, 2))
    one, path = draw_network(1, 0, 60, np.r_[NET_SQUARES, asked]), tmp_path / "model.ckpt"
    names = [f"{t // 3}-{t % 3}" for t in range(30)]
    other = draw_network(8, 0, 60, NET_SQUARES)
    right, wrong = (
        network_rasters(tmp_path / f"{name}.tif", level[: len(NET_SQUARES)], names)
        for name, level in (("right", one.truth), ("wrong", other.truth))
    )
    asked, truth = one.asked[len(NET_SQUARES) :], one.truth[len(NET_SQUARES) :]
    settings = {"settings": {"prior": right}, "save": path}, {"settings": {"prior": wrong}}
    found = [gsparc.fit(**one.arrays(6), **more) for more in ({}, *settings)]
    error = [np.sqrt(np.mean((model.rssi(rx=asked) - truth) ** 2)) for model in found]
    assert error[1] < 0.95 * error[0] and error[2] < 1.02 * error[0], error
    assert all(describe_use(used, 30) in caplog.text for used in (True, False))  # it was not said
    right.unlink()
    np.testing.assert_allclose(gsparc.load(path).rssi(rx=asked), found[1].rssi(rx=asked), atol=1e-3)


@pytest.mark.parametrize("count", [1, 2])
def test_a_map_of_a_station_at_an_unknown_place_was_written_and_never_read(rasters, count):
    """Its place, NaN, stood in the state."""
    rows, asked, path = draw(30, 3), draw(20, 4), rasters / "model.ckpt"
    names = (
        {"station": np.arange(30) % 2, "station_name": np.array(["a", "b"])} if count == 2 else {}
    )
    unknown = {"tx": None, "station_position": np.full((2, 3), np.nan) if names else None}
    file = "two" if names else "right"
    found = fit(rows, rasters / f"{file}.tif", model="powers", save=path, **names, **unknown)
    (rasters / f"{file}.tif").unlink()  # a model keeps its map
    assert np.array_equal(gsparc.load(path).rssi(rx=asked), found.rssi(rx=asked))

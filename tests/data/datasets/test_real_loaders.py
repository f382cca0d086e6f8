"""Layouts of measured campaigns: what is read, and what is refused in one line with array and row."""

from __future__ import annotations

import numpy as np
import pytest
from measured import (
    ANTENNAS,
    CYCLES,
    DEGREES,
    HOSTS,
    KINDS,
    STATIONS,
    TABLE,
    ble_arrays,
    channels_of,
    powder_arrays,
    release_variables,
    techtile_arrays,
    write_npz,
    write_release,
    write_walk,
)
from releases import real

from gsparc.data.datasets.ble import raw_of_ble
from gsparc.data.datasets.powder import raw_of_powder
from gsparc.data.datasets.techtile import raw_of_techtile
from gsparc.data.errors import DataError
from gsparc.data.raw import read_netcdf, read_raw

READERS = {"techtile": raw_of_techtile, "powder": raw_of_powder, "ble": raw_of_ble}
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)


def refused(read, *arguments) -> DataError:
    """The error, which is one line."""
    with pytest.raises(DataError) as caught:
        read(*arguments)
    assert "\n" not in str(caught.value)
    return caught.value


def test_techtile_npz(tmp_path):
    raw, arrays = raw_of_techtile(write_npz(tmp_path, "techtile")), techtile_arrays()
    assert set(raw.arrays) == {"tx_position", "station_position", "csi", "mask", "run", "frequency_hz"}
    assert np.array_equal(raw.arrays["station_position"], ANTENNAS)
    assert np.array_equal(raw.arrays["csi"], arrays["csi"]) and raw.attributes["name"] == "techtile"


@EVERY_KIND
def test_techtile_release(tmp_path, kind):
    raw = raw_of_techtile(write_release(tmp_path, kind))
    held, rows = raw.arrays, 2 * CYCLES - 2  # one without position, one without channels
    assert held["tx_position"].shape == (rows, 3) and held["tx_position"].dtype == np.float64
    assert held["station_name"].tolist() == HOSTS.tolist()
    assert np.array_equal(held["station_position"], ANTENNAS)  # matched by tile, not by order
    assert held["frequency_hz"] == 920e6 and np.isfinite(held["csi"]).all()
    assert held["row_name"][0] == "EXP005 cycle 1" and held["row_name"][-1] == "EXP006 cycle 7"
    assert held["run"].tolist() == ["EXP005"] * CYCLES + ["EXP006"] * (CYCLES - 2)
    assert held["mask"].sum() == 3 * rows - 1 and not held["mask"][3, 2]
    assert raw.attributes["left_out"] == "1 of 15 cycles left out: no position"


@EVERY_KIND
def test_techtile_phases_fall_with_distance(tmp_path, kind):
    """The release stores reference minus received phase, which rises with it."""
    held = raw_of_techtile(write_release(tmp_path, kind)).arrays
    expected = channels_of(held["tx_position"])
    assert np.allclose(held["csi"][held["mask"]], expected[held["mask"]], atol=1e-6)


@EVERY_KIND
def test_techtile_release_of_one_experiment(tmp_path, kind):
    variables = {
        name: (dimensions[1:], values[0]) if dimensions[0] == "experiment_id" else (dimensions, values)
        for name, (dimensions, values) in release_variables().items()
    }
    del variables["experiment_id"]
    held = raw_of_techtile(write_release(tmp_path, kind, variables)).arrays
    assert held["csi"].shape == (CYCLES, 3) and set(held["run"]) == {"csi"}


def test_techtile_release_without_flags(tmp_path):
    variables = {n: v for n, v in release_variables().items() if not n.endswith("_available")}
    with_flags = raw_of_techtile(write_release(tmp_path)).arrays["mask"]
    assert np.array_equal(
        raw_of_techtile(write_release(tmp_path, variables=variables)).arrays["mask"], with_flags
    )


def test_techtile_antennas_may_lie_elsewhere(tmp_path):
    path = write_release(tmp_path)
    table = (tmp_path / "techtile_antenna_locations.yml").rename(tmp_path / "ceiling.yml")
    assert np.array_equal(raw_of_techtile(path, table).arrays["station_position"], ANTENNAS)
    assert "name the file with dataset.antennas" in str(refused(raw_of_techtile, path))


def test_techtile_antennas_may_be_in_the_file(tmp_path):
    variables = {**release_variables(), "rx_antenna_position": (("hostname", "xyz"), ANTENNAS)}
    path = write_release(tmp_path, variables=variables, antennas=False)
    assert np.array_equal(raw_of_techtile(path).arrays["station_position"], ANTENNAS)


@EVERY_KIND
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda v: [v.pop(n) for n in ("csi_imag", "rover_z")],
            "csi.nc: csi_imag, rover_z missing in a Techtile",
        ),
        (
            lambda v: v.update(csi_real=(("h", "c"), np.zeros((3, 8)))),
            "csi.nc, csi_imag: expected shape (E, C, H)",
        ),
        (
            lambda v: v.update(csi_imag=(("h", "c", "e"), np.zeros((3, 8, 2)))),
            "csi.nc, csi_imag: expected shape (E, C, H) with E = 2 as in csi_real, C = 8 as in csi_real, "
            "H = 3 as in csi_real, found (3, 8, 2); transposed?",
        ),
        (
            lambda v: v.update(hostname=(("g",), np.array(["A05", "A06"]))),
            "csi.nc, hostname: expected shape (H,)",
        ),
        (
            lambda v: v.update(hostname=(("hostname",), np.array(["A05", "A06", "G99"]))),
            "techtile_antenna_locations.yml: no antenna of the tiles G99",
        ),
        (
            lambda v: v.update(position_available=(v["rover_x"][0], np.zeros((2, CYCLES), np.int8))),
            "csi.nc: no cycle has both a position and a channel",
        ),
        (
            lambda v: v.update(rover_y=(v["rover_x"][0], np.full((2, CYCLES), np.nan))),
            "csi.nc: no cycle has both a position and a channel",
        ),
    ],
)
def test_spoilt_techtile_releases(tmp_path, kind, change, words):
    variables = release_variables()
    change(variables)
    assert words in str(refused(raw_of_techtile, write_release(tmp_path, kind, variables)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("antennes: 3", "expected `antennes:` with a list"),
        ("antennes:\n- tile: A05\n", "no antenna of the tiles A06, B05"),
        (
            "antennes:\n" + "".join(f"- {{tile: {h}, channels: [{{x: 1, y: 2, z: 3}}]}}\n" for h in HOSTS),
            "A05: expected x, y, z [m] of channel 1",
        ),
        (
            "antennes:\n"
            + "".join(f"- {{tile: {h}, channels: {{1: {{x: .nan, y: 2, z: 3}}}}}}\n" for h in HOSTS),
            "A05: expected x, y, z [m] of channel 1",
        ),
        ("[1, 2", "not readable as YAML"),
    ],
)
def test_spoilt_tables_of_antennas(tmp_path, text, words):
    path = write_release(tmp_path)
    (tmp_path / "techtile_antenna_locations.yml").write_text(text)
    assert words in str(refused(raw_of_techtile, path))


@EVERY_KIND
def test_damaged_netcdf(tmp_path, kind):
    path = write_release(tmp_path, kind)
    whole = path.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:40], b"CDF\x05" + whole[4:]):
        path.write_bytes(content)
        assert "csi.nc: " in str(refused(read_netcdf, path))
    assert "no such file" in str(refused(read_netcdf, tmp_path / "other.nc"))


def test_values_that_were_never_written_are_none(tmp_path):
    variables = release_variables()
    variables["rover_x"][1][0, 2] = 9.969209968386869e36
    raw = raw_of_techtile(write_release(tmp_path, variables=variables))
    assert (
        raw.attributes["left_out"].startswith("2 of 15 cycles")
        and np.isfinite(raw.arrays["tx_position"]).all()
    )


def test_powder_npz_is_geographic(tmp_path):
    raw, arrays = raw_of_powder(write_npz(tmp_path, "powder")), powder_arrays()
    held = raw.arrays
    assert np.array_equal(held["latitude"], arrays["latitude"])
    where = np.stack([held["station_latitude"], held["station_longitude"]], axis=1)
    assert np.abs(where - DEGREES).max() < 1e-9  # a tenth of a millimetre
    assert held["station_name"].tolist() == STATIONS.tolist() and held["carrier_hz"] == 462.7e6
    assert held["tx_height"] == 1.5 and held["station_height"] == 10
    assert np.array_equal(held["rssi_db"], arrays["rssi_db"], equal_nan=True)
    assert "tx_position" not in held


def test_powder_npz_without_degrees_stays_in_metres(tmp_path):
    def metric(arrays):
        return {n: a for n, a in arrays.items() if n not in ("latitude", "longitude", "frequency_hz")}

    held = raw_of_powder(write_npz(tmp_path, "powder", metric), None, 1.2, 20).arrays
    assert held["tx_position"].shape == (20, 2) and held["station_position"].shape == (3, 2)
    assert held["tx_height"] == 1.2 and held["station_height"] == 20 and "latitude" not in held
    assert held["carrier_hz"] == 462.7e6


def test_powder_csv_holds_the_same(tmp_path):
    table, npz = raw_of_powder(write_walk(tmp_path)), raw_of_powder(write_npz(tmp_path, "powder"))
    for name in npz.arrays:
        same, other = table.arrays[name], npz.arrays[name]
        if same.dtype.kind == "f":
            assert np.allclose(same, other, rtol=0, atol=1e-9, equal_nan=True), name
        else:
            assert np.array_equal(same, other), name
    assert np.isnan(table.arrays["rssi_db"]).sum() == 2  # -101 in the release
    assert table.arrays["row_name"][0] == "line 2"
    assert "3 columns left out, no fixed place: bus-6186_rss" in table.attributes["left_out"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("tx_x_coord,tx_y_coord", "latitude,longitude"),
        ("tx_x_coord,tx_y_coord", "TX Lat , TX Lon"),
        ("timestamp", "Time"),
        ("-101", ""),
        ("-101", "NaN"),
        ("\n", "\r\n"),
        ("\n2022-11-23 13:24:05", "\n\n2022-11-23 13:24:05"),
    ],
)
def test_powder_csv_is_read_in_other_spellings(tmp_path, old, new):
    plain = raw_of_powder(write_walk(tmp_path)).arrays
    other = raw_of_powder(write_walk(tmp_path, lambda text: text.replace(old, new))).arrays
    for name in set(plain) - {"row_name"}:
        assert np.array_equal(plain[name], other[name], equal_nan=plain[name].dtype.kind == "f"), name


@pytest.mark.parametrize(
    "table",
    [
        '{"ebc-nuc1-b210": [40.7677, -111.83816], "bus-6186": null}',
        "{'ebc-nuc1-b210': (40.7677, -111.83816),}",
    ],
)
def test_powder_tables_of_stations(tmp_path, table):
    raw = raw_of_powder(write_walk(tmp_path, table=table))
    assert raw.arrays["station_name"].tolist() == ["ebc-nuc1-b210"] and raw.arrays["rssi_db"].shape == (20, 1)
    assert "madsen-nuc2-b210" in raw.attributes["left_out"]
    rows = "Name, Latitude, Longitude\nebc-nuc1-b210, 40.7677, -111.83816\n"
    (tmp_path / "where.csv").write_text(rows)
    again = raw_of_powder(tmp_path / "single_tx.csv", tmp_path / "where.csv")
    assert np.array_equal(again.arrays["station_latitude"], raw.arrays["station_latitude"])


SPOILT_WALKS = {
    "no header": (lambda t: t.partition("\n")[2], TABLE, "line 1: no column tx_x_coord (or "),
    "empty": (lambda t: "", TABLE, "single_tx.csv: no rows"),
    "header alone": (lambda t: t.partition("\n")[0], TABLE, "single_tx.csv: no rows"),
    "binary": (lambda t: t, "\x00\x01", "location_coordinates.json: not readable"),
    "no longitude": (lambda t: t.replace("tx_y_coord", "east"), TABLE, "line 1: no column tx_y_coord"),
    "swapped degrees": (
        lambda t: t.replace("tx_x_coord,tx_y_coord", "tx_y_coord,tx_x_coord"),
        TABLE,
        "are tx_x_coord and tx_y_coord swapped?",
    ),
    "a word": (
        lambda t: t.replace(":01,-101,-1,-1,-", ":01,-101,-1,-1,loud-"),
        TABLE,
        "line 3, ebc-nuc1-b210: expected a number",
    ),
    "cells missing": (lambda t: t.replace(",-101,-1,-1", "", 1), TABLE, "line 2: expected 9 cells, found 6"),
    "no degrees": (
        lambda t: t[: t.rindex(",")] + ",nan\n",
        TABLE,
        "single_tx.csv, tx_y_coord, line 21 = nan",
    ),
    "two transmitters": (
        lambda t: t.replace("tx_x_coord", "tx1_x_coord,tx2_x_coord").replace("tx_y_coord", "tx1_y_coord"),
        TABLE,
        "line 1: two transmitters in a row",
    ),
    "column twice": (lambda t: t.replace(STATIONS[1], STATIONS[0]), TABLE, "column ebc-nuc1-b210 twice"),
    "no station": (lambda t: t, '{"other": [40.0, -111.0]}', "no column is a station of"),
    "stations that drive": (lambda t: t, '{"ebc-nuc1-b210": None}', "no station with coordinates"),
    "station in words": (
        lambda t: t,
        '{"ebc-nuc1-b210": ["north", 1]}',
        "ebc-nuc1-b210: expected latitude and",
    ),
    "station beyond the pole": (
        lambda t: t,
        '{"ebc-nuc1-b210": [-111.8, 40.7]}',
        "is no latitude and longitude",
    ),
    "table is code": (lambda t: t, "__import__('os').getcwd()", "location_coordinates.json: not readable"),
    "table is a list": (lambda t: t, "[1, 2]", "expected a table from names"),
}


@pytest.mark.parametrize(("change", "table", "words"), SPOILT_WALKS.values(), ids=SPOILT_WALKS)
def test_spoilt_powder_tables(tmp_path, change, table, words):
    assert words in str(refused(raw_of_powder, write_walk(tmp_path, change, table)))


def test_absent_powder_files(tmp_path):
    path = write_walk(tmp_path)
    (tmp_path / "location_coordinates.json").unlink()
    assert "name the file with dataset.station_table" in str(refused(raw_of_powder, path))
    (tmp_path / "location_coordinates.json").write_text(TABLE)
    assert "no such file" in str(refused(raw_of_powder, tmp_path / "other.csv"))


@pytest.mark.parametrize("height", [float("nan"), "high", True, None])
def test_heights_are_metres(tmp_path, height):
    path = write_npz(tmp_path, "powder")
    assert "dataset.tx_height=" in str(refused(raw_of_powder, path, None, height))
    assert "dataset.station_height=" in str(refused(raw_of_powder, path, None, 1.5, height))


def test_powder_metres_and_degrees_must_agree(tmp_path):
    def moved(arrays):
        return {**arrays, "latitude": arrays["latitude"] + 0.01 * (np.arange(20) == 7)}

    error = refused(raw_of_powder, write_npz(tmp_path, "powder", moved))
    assert "powder.npz, mobile_position, row 7: " in str(error) and "m from where latitude" in str(error)


def test_ble_npz(tmp_path):
    raw, arrays = raw_of_ble(write_npz(tmp_path, "ble")), ble_arrays()
    assert np.array_equal(raw.arrays["tx_position"], arrays["mobile_position"])
    assert np.array_equal(raw.arrays["station_position"], arrays["station_position"])
    assert raw.arrays["station_name"].tolist() == arrays["station"].tolist()
    assert raw.arrays["carrier_hz"] == 2.44e9 and raw.arrays["rssi_db"].shape == (15, 4)


def without(name):
    """A change that drops one array."""
    return lambda arrays: {n: a for n, a in arrays.items() if n != name}


def with_(name, change):
    """A change of one array."""
    return lambda arrays: {**arrays, name: change(arrays[name])}


def nan_at(row, column):
    """A change of one number."""

    def change(array):
        changed = array.copy()
        changed[row, column] = np.nan
        return changed

    return change


SPOILT = {
    "places missing": (
        "ble",
        without("mobile_position"),
        "mobile_position: missing; expected real numbers (S, 3)",
    ),
    "powers missing": ("ble", without("rssi_db"), "rssi_db: missing; expected real numbers (S, T)"),
    "table missing": ("ble", without("station_position"), "station_position: missing"),
    "channels missing": ("techtile", without("csi"), "csi: missing; expected complex numbers (S, T)"),
    "frequency missing": (
        "techtile",
        without("frequency_hz"),
        "frequency_hz: missing; expected real numbers ()",
    ),
    "places transposed": (
        "ble",
        with_("mobile_position", np.transpose),
        "mobile_position: expected shape (S, 3), found (3, 15); transposed?",
    ),
    "powers transposed": (
        "ble",
        with_("rssi_db", np.transpose),
        "rssi_db: expected shape (S, T) with S = 15 as in mobile_position, T = 4 as in station_position, "
        "found (4, 15); transposed?",
    ),
    "channels transposed": ("techtile", with_("csi", np.transpose), "found (3, 12); transposed?"),
    "mask transposed": ("techtile", with_("mask", np.transpose), "mask: expected shape (S, T) with"),
    "places in 3-D": (
        "powder",
        with_("mobile_position", lambda a: np.c_[a, a[:, :1]]),
        "(S, 2), found (20, 3)",
    ),
    "places in 2-D": ("ble", with_("mobile_position", lambda a: a[:, :2]), "(S, 3), found (15, 2)"),
    "table too short": (
        "powder",
        with_("station_position", lambda a: a[:-1]),
        "rssi_db: expected shape (S, T) with S = 20 as in mobile_position, T = 2 as in station_position, "
        "found (20, 3)",
    ),
    "names too few": ("ble", with_("station", lambda a: a[:-1]), "station: expected shape (T,) with T = 4"),
    "names are numbers": (
        "ble",
        with_("station", lambda a: np.arange(4)),
        "station: expected text, found dtype",
    ),
    "runs too few": ("techtile", with_("run", lambda a: a[:-1]), "run: expected shape (S,) with S = 12"),
    "channels real": ("techtile", with_("csi", np.abs), "csi: expected complex numbers, found dtype float32"),
    "powers in words": ("ble", with_("rssi_db", lambda a: a.astype(str)), "rssi_db: expected real numbers"),
    "place NaN": ("ble", with_("mobile_position", nan_at(7, 1)), "mobile_position, row 7 = ("),
    "2-D place NaN": ("powder", with_("mobile_position", nan_at(7, 1)), "mobile_position, row 7 = ("),
    "station NaN": ("powder", with_("station_position", nan_at(1, 0)), "station_position, row 1 = (nan"),
    "antenna NaN": ("techtile", with_("rx_antenna_position", nan_at(2, 2)), "rx_antenna_position, row 2 = ("),
    "place beyond Earth": (
        "techtile",
        with_("tx_position", lambda a: a * 1e9),
        "expected finite coordinates",
    ),
    "latitude NaN": ("powder", with_("latitude", lambda a: a * np.nan), "latitude, row 0 = nan"),
    "latitude beyond the pole": (
        "powder",
        with_("latitude", lambda a: a + 60),
        "expected degrees, at most 90",
    ),
}


@pytest.mark.parametrize(("name", "change", "words"), SPOILT.values(), ids=SPOILT)
def test_spoilt_files(tmp_path, name, change, words):
    error = refused(READERS[name], write_npz(tmp_path, name, change))
    assert words in str(error) and str(error).startswith(f"{tmp_path / name}.npz")


@pytest.mark.parametrize("name", READERS)
def test_other_files(tmp_path, name):
    assert "no such file" in str(refused(READERS[name], tmp_path / "absent.npz"))
    path = write_npz(tmp_path, name)
    path.write_bytes(path.read_bytes()[:100])
    assert "damaged or not an npz" in str(refused(READERS[name], path))


def test_another_campaign_s_file(tmp_path):
    error = refused(raw_of_techtile, write_npz(tmp_path, "ble"))
    assert "ble.npz, tx_position: missing; expected real numbers (S, 3)" in str(error)


def test_measured_techtile():
    raw = raw_of_techtile(real("real/techtile-csi-920mhz.npz"))
    held = raw.arrays
    assert held["csi"].shape == (1015, 42) and held["station_position"].shape == (42, 3)
    assert set(held["run"]) == {"EXP005", "EXP006"} and (~held["mask"]).sum() == 4
    # One unknown phase per antenna and run: along the line of sight phases fall with distance.
    distance = np.linalg.norm(held["tx_position"][:, None] - held["station_position"], axis=-1)
    turn = 2 * np.pi * held["frequency_hz"] / 299_792_458 * distance
    phase = np.where(held["mask"], np.exp(1j * np.angle(held["csi"])), 0)[held["run"] == "EXP005"]
    falling, rising = (
        np.abs((phase * np.exp(sign * 1j * turn[held["run"] == "EXP005"])).mean(axis=0)).mean()
        for sign in (1, -1)
    )
    assert falling > 0.3 > 0.1 > rising


def test_measured_powder():
    held = raw_of_powder(real("real/powder-rss-462mhz.npz")).arrays
    assert held["rssi_db"].shape == (5006, 12) and held["latitude"].shape == (5006,)
    station = held["station_name"].tolist().index("ebc-nuc1-b210")
    # As in the release's own table, to its five digits.
    assert np.allclose(held["station_latitude"][station], 40.7677, atol=1e-7)
    assert np.allclose(held["station_longitude"][station], -111.83816, atol=1e-7)
    assert np.nanmin(held["rssi_db"]) > -101


@pytest.mark.parametrize(("hall", "rows"), [(1, 81), (2, 45)])
def test_measured_ble(hall, rows):
    held = raw_of_ble(real(f"real/ble-hall-{hall}.npz")).arrays
    assert held["rssi_db"].shape == (rows, 12) and held["tx_position"].shape == (rows, 3)
    assert held["station_name"][0] == "sensor10" and np.isfinite(held["rssi_db"]).all()


def test_the_measured_plane_is_named_as_one_s_own():
    held = read_raw(real("real/techtile-power-reci-rf-1.npz")).arrays
    assert set(held) == {"rx_position", "rssi_db", "frequency_hz"}
    assert held["rx_position"].shape == (20382, 3) and held["rssi_db"].shape == (20382,)

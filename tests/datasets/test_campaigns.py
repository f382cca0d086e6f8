"""Layouts of measured campaigns: what is read and measured,
and what is refused with array and row.
"""

import numpy as np
import pytest
from measured import (
    ANTENNAS,
    CYCLES,
    DEGREES,
    HOSTS,
    KINDS,
    MAKERS,
    STATIONS,
    TABLE,
    channels_of,
    powder_arrays,
    release_variables,
    write_npz,
    write_release,
    write_walk,
)
from releases import REAL, release

from gsparc.datasets.load import load
from gsparc.datasets.own import CAMPAIGNS, read_any
from gsparc.datasets.powder import read_powder
from gsparc.datasets.techtile import read_techtile
from gsparc.tables.raw import Raw, read_raw, write_raw

LOADERS = {kind.choice: kind.reader for kind in CAMPAIGNS}
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)


@EVERY_KIND
def test_techtile_release(tmp_path, kind):
    raw = read_techtile(write_release(tmp_path, kind))
    held, rows = raw.arrays, 2 * CYCLES - 2  # one without position, one without channels
    assert held["tx_position"].shape == (rows, 3) and held["tx_position"].dtype == np.float64
    assert held["station_name"].tolist() == HOSTS.tolist()
    assert np.array_equal(held["station_position"], ANTENNAS)  # matched by tile, not by order
    assert held["frequency_hz"] == 920e6 and np.isfinite(held["csi"]).all()
    assert held["row_name"][0] == "EXP005 cycle 1" and held["row_name"][-1] == "EXP006 cycle 7"
    assert held["run"].tolist() == ["EXP005"] * CYCLES + ["EXP006"] * (CYCLES - 2)
    assert held["mask"].sum() == 3 * rows - 1 and not held["mask"][3, 2]
    assert raw.notes[0] == "1 of 15 cycles left out: no position"
    # The release stores reference minus received phase, which rises with distance.
    expected = channels_of(held["tx_position"])
    assert np.allclose(held["csi"][held["mask"]], expected[held["mask"]], atol=1e-6)


TECHTILE = {
    "missing": (
        {"csi_imag": None, "rover_z": None},
        "csi.nc, csi_imag: missing; expected real numbers (E, C, H)",
    ),
    "one experiment of two": (
        {"csi_real": (("h", "c"), np.zeros((3, 8)))},
        "csi.nc, csi_imag: expected shape (E, C, H)",
    ),
    "transposed": (
        {"csi_imag": (("h", "c", "e"), np.zeros((3, 8, 2)))},
        "csi.nc, csi_imag: expected shape (E, C, H), here (2, 8, 3), found (3, 8, 2); transposed?",
    ),
    "another host": (
        {"hostname": (("hostname",), np.array(["A05", "A06", "G99"]))},
        "techtile_antenna_locations.yml: no antenna of the tiles G99",
    ),
    "no position": (
        {"position_available": (("experiment_id", "cycle_id"), np.zeros((2, CYCLES), np.int8))},
        "csi.nc: no cycle has both a position and a channel",
    ),
}


@pytest.mark.parametrize("case", TECHTILE)
def test_spoilt_techtile_releases(tmp_path, refused, case):
    change, says = TECHTILE[case]
    variables = {
        name: value
        for name, value in {**release_variables(), **change}.items()
        if value is not None
    }
    refused(says, read_techtile, write_release(tmp_path, variables=variables))


ONE_CHANNEL, NAN_CHANNEL = "channels: [{x: 1, y: 2, z: 3}]", "channels: {1: {x: .nan, y: 2, z: 3}}"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("antennes: 3", "expected `antennes:` with a list"),
        ("antennes:\n- tile: A05\n", "no antenna of the tiles A06, B05"),
        *(
            (
                "antennes:\n" + "".join(f"- {{tile: {h}, {c}}}\n" for h in HOSTS),
                "A05: expected x, y, z [m] of channel 1",
            )
            for c in (ONE_CHANNEL, NAN_CHANNEL)
        ),
        ("[1, 2", "not readable as YAML"),
    ],
)
def test_spoilt_tables_of_antennas(tmp_path, refused, text, says):
    path = write_release(tmp_path)
    (tmp_path / "techtile_antenna_locations.yml").write_text(text)
    refused(says, read_techtile, path)


@EVERY_KIND
def test_damaged_netcdf(tmp_path, refused, kind):
    path = write_release(tmp_path, kind)
    whole = path.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:40], b"CDF\x05" + whole[4:]):
        path.write_bytes(content)
        refused("csi.nc: ", read_raw, path)
    refused("no such file", read_raw, tmp_path / "other.nc")


def test_noise_of_powder_receivers_could_not_be_told_from_levels(tmp_path, refused):
    """`check` named four stations and `sensitivity_db`, which the release's files cannot hold."""
    own = {"name": "powder", "file": str(write_walk(tmp_path))}
    level = np.sort(powder_arrays()["rssi_db"][:, 0])
    floors = {STATIONS[0]: float(level[5] + level[4]) / 2}
    before, after = load(own), load({**own, "sensitivity_db": floors})
    side = after.censored_side(np.arange(len(after)))
    assert before.censored is None and set(after.station[side > 0]) == {0}
    assert ((side == 0) & (after.station == 0)).sum() == np.isfinite(level[5:]).sum()
    refused(
        "sensitivity_db='ebc': one of",
        lambda _: load({**own, "sensitivity_db": {"ebc": -90}}),
        tmp_path,
    )


SWAPPED = ("tx_x_coord,tx_y_coord", "tx_y_coord,tx_x_coord")
WALKS = {  # what is replaced in the walk (None: all of it), the table of stations, and what is said
    "empty": (None, TABLE, "single_tx.csv: empty; expected a line of heads"),
    "no latitude": (("tx_x_coord", "east"), TABLE, "line 1: no column tx_x_coord; "),
    "swapped degrees": (
        SWAPPED,
        TABLE,
        " is outside -90 to 90 degrees; are latitude and longitude swapped?",
    ),
    "a word": (
        (":01,-101,-1,-1,-", ":01,-101,-1,-1,loud-"),
        TABLE,
        "column 'ebc-nuc1-b210', line 3: 'loud-",
    ),
    "no degrees": (
        (f",{powder_arrays()['longitude'][-1]!s}\n", ",nan\n"),
        TABLE,
        "column 'tx_y_coord', line 21: no value",
    ),
    "two transmitters": (
        ("tx_x_coord,tx_y", "tx1_x_coord,tx2_x"),
        TABLE,
        "line 1: no column tx_x_coord and tx_y_coord",
    ),
    "column twice": ((STATIONS[1], STATIONS[0]), TABLE, "are both named 'ebc-nuc1-b210'"),
    "no station": (("", ""), '{"other": [40.0, -111.0]}', "no column is a station of"),
    "stations that drive": (("", ""), '{"ebc-nuc1-b210": None}', "no station with coordinates"),
    "station in words": (
        ("", ""),
        '{"ebc-nuc1-b210": ["north", 1]}',
        "ebc-nuc1-b210: expected latitude and",
    ),
    "station beyond the pole": (
        ("", ""),
        '{"ebc-nuc1-b210": [-111.8, 40.7]}',
        "ebc-nuc1-b210: latitude -111.8 is outside",
    ),
    "table is code": (
        ("", ""),
        "__import__('os').getcwd()",
        "location_coordinates.json: not readable",
    ),
}


@pytest.mark.parametrize("case", WALKS)
def test_spoilt_powder_tables(tmp_path, refused, case):
    change, table, says = WALKS[case]
    refused(
        says,
        read_powder,
        write_walk(tmp_path, lambda t: t.replace(*change) if change else "", table),
    )


EVERY = pytest.mark.parametrize("name", MAKERS)


@EVERY
def test_absent_damaged_and_foreign_files(tmp_path, refused, name):
    refused("no such file", LOADERS[name], tmp_path / "absent.npz")
    path = write_npz(tmp_path, name)
    path.write_bytes(path.read_bytes()[:100])
    refused("damaged or not an npz", LOADERS[name], path)
    foreign = write_npz(tmp_path, "ble" if name == "techtile" else "techtile")
    refused("position: missing", LOADERS[name], foreign)


@pytest.mark.parametrize("form", ["npz", "csv"])
def test_powder_is_links_on_the_earth(tmp_path, form):
    path = write_npz(tmp_path, "powder") if form == "npz" else write_walk(tmp_path)
    assert form == "csv" or any("dataset=powder" in note for note in read_any(path).notes)
    data, arrays = load({"name": "powder", "file": str(path)}), powder_arrays()
    assert data.site.kind == "rssi" and data.site.static_end == "rx" and len(data) == 58
    heard = 10 * np.log10(data.target[:, 0].astype(float) * data.site.target_scale)
    assert np.allclose(heard, arrays["rssi_db"][data.place, data.station], atol=1e-3)
    walk = np.stack([arrays["latitude"], arrays["longitude"]], axis=-1)[data.place]
    for place, degrees, height in (
        (data.moving, walk, 1.5),
        (data.site.stations.position, DEGREES, 10),
    ):
        world = place + data.site.origin
        found = np.stack(data.site.georeference.to_degrees(world[:, :2]), axis=-1)
        assert np.abs(found - degrees).max() < 1e-7 and np.allclose(world[:, 2], height)


MEASURED = {
    "techtile-csi-920mhz": "techtile",
    "ble-hall-1": "ble",
    "techtile-power-reci-rf-1": None,
}


@pytest.mark.parametrize(("file", "campaign"), MEASURED.items())
def test_check_reads_a_measured_campaign_as_its_loader_does(file, campaign):
    path = release(f"real/{file}.npz")
    with np.load(path) as stored:
        rows = stored["mask"].sum() if "mask" in stored else stored["rssi_db"].size
        if campaign is None and path.is_relative_to(REAL):  # rows of one fix are one
            rows = rows - 30
    reading = read_any(path)
    assert any(f"dataset={campaign}" in note for note in reading.notes) == (campaign is not None)
    loaded = load({"name": campaign or "own", "file": str(path)})
    assert reading.data.site.sha256 == loaded.site.sha256 and len(loaded) == rows


def test_own_names_the_campaign_of_a_file(tmp_path, refused):
    file = tmp_path / "hall.npz"
    np.savez(file, mobile_position=np.eye(3), station_position=np.eye(3), rssi_db=np.zeros((3, 3)))
    refused(
        "this is a file of dataset=ble; say dataset=ble", load, {"name": "own", "file": str(file)}
    )


def test_units_of_a_converted_file_were_not_looked_at(tmp_path, refused):
    """Under their names in the file, which are not the schema's."""
    with np.load(release("real/ble-hall-1.npz")) as stored:
        write_raw(tmp_path / "hall.npz", Raw(dict(stored), {}, {"mobile_position": "mm"}))
    refused(
        "tx_position: units are 'mm'; expected 'm'",
        lambda path: read_any(path).data,
        tmp_path / "hall.npz",
    )

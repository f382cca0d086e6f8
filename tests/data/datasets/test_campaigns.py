"""Layouts of measured campaigns: what is read and measured, and what is refused with array and row."""
# ruff: noqa: E501 (a case is a row of a table)

import numpy as np
import pytest
from measured import (
    DEGREES,
    MAKERS,
    STATIONS,
    TABLE,
    powder_arrays,
    write_npz,
    write_walk,
)
from releases import real

from gsparc.data.datasets.own import LOADERS, read_any
from gsparc.data.datasets.powder import read_powder
from gsparc.data.errors import DataError
from gsparc.data.load import load
from gsparc.data.raw import Raw, write_raw


def test_powder_stations_without_a_place_are_left_out(tmp_path):
    raw = read_powder(
        write_walk(tmp_path, table="{'ebc-nuc1-b210': (40.7677, -111.83816), 'bus-6186': None}")
    )
    assert raw.arrays["station_name"].tolist() == ["ebc-nuc1-b210"] and raw.arrays["rssi_db"].shape == (20, 1)
    assert "madsen-nuc2-b210" in raw.notes[0]


SWAPPED = ("tx_x_coord,tx_y_coord", "tx_y_coord,tx_x_coord")
WALKS = {  # what is replaced in the walk (None: all of it), the table of stations, and what is said
    "empty": (None, TABLE, "single_tx.csv: empty; expected a line of heads"),
    "no latitude": (("tx_x_coord", "east"), TABLE, "line 1: no column tx_x_coord; "),
    "swapped degrees": (SWAPPED, TABLE, "latitude is outside -90 to 90 degrees; are latitude and longitude swapped?"),
    "a word": ((":01,-101,-1,-1,-", ":01,-101,-1,-1,loud-"), TABLE, "column 'ebc-nuc1-b210', line 3: 'loud-"),
    "no degrees": ((f",{powder_arrays()['longitude'][-1]!s}\n", ",nan\n"), TABLE, "column 'tx_y_coord', line 21: no value"),
    "two transmitters": (("tx_x_coord,tx_y", "tx1_x_coord,tx2_x"), TABLE, "line 1: no column tx_x_coord and tx_y_coord"),
    "column twice": ((STATIONS[1], STATIONS[0]), TABLE, "are both named 'ebc-nuc1-b210'"),
    "no station": (("", ""), '{"other": [40.0, -111.0]}', "no column is a station of"),
    "stations that drive": (("", ""), '{"ebc-nuc1-b210": None}', "no station with coordinates"),
    "station in words": (("", ""), '{"ebc-nuc1-b210": ["north", 1]}', "ebc-nuc1-b210: expected latitude and"),
    "station beyond the pole": (("", ""), '{"ebc-nuc1-b210": [-111.8, 40.7]}', "ebc-nuc1-b210: latitude -111.8 is outside"),
    "table is code": (("", ""), "__import__('os').getcwd()", "location_coordinates.json: not readable"),
}  # fmt: skip


@pytest.mark.parametrize("case", WALKS)
def test_spoilt_powder_tables(tmp_path, refused, case):
    change, table, says = WALKS[case]
    refused(says, read_powder, write_walk(tmp_path, lambda t: t.replace(*change) if change else "", table))


def test_absent_powder_files(tmp_path, refused):
    path = write_walk(tmp_path)
    (tmp_path / "location_coordinates.json").unlink()
    refused("name the file with dataset.station_table", read_powder, path)
    refused("no such file", read_powder, tmp_path / "other.csv")


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
    for place, degrees, height in ((data.moving, walk, 1.5), (data.site.stations.position, DEGREES, 10)):
        world = place + data.site.origin
        found = np.stack(data.site.georeference.to_degrees(world[:, :2]), axis=-1)
        assert np.abs(found - degrees).max() < 1e-7 and np.allclose(world[:, 2], height)


MEASURED = [
    ("techtile-csi-920mhz.npz", "techtile", 1015 * 42 - 4), ("ble-hall-1.npz", "ble", 81 * 12), ("ble-hall-2.npz", "ble", 45 * 12),
    ("techtile-power-reci-rf-1.npz", None, 20382),
]  # fmt: skip


@pytest.mark.parametrize(("file", "campaign", "rows"), MEASURED)
def test_check_reads_a_measured_campaign_as_its_loader_does(file, campaign, rows):
    path = real(f"real/{file}")
    reading = read_any(path)
    assert any(f"dataset={campaign}" in note for note in reading.notes) == (campaign is not None)
    loaded = load({"name": campaign or "own", "file": str(path)})
    assert reading.data.site.sha256 == loaded.site.sha256 and len(loaded) == rows


def test_own_names_the_campaign_of_a_file(tmp_path):
    file = tmp_path / "hall.npz"
    np.savez(file, mobile_position=np.eye(3), station_position=np.eye(3), rssi_db=np.zeros((3, 3)))
    with pytest.raises(DataError, match="this is a file of dataset=ble; say dataset=ble"):
        load({"name": "own", "file": str(file)})


def test_units_of_a_converted_file_were_not_looked_at(tmp_path, refused):
    """Under their names in the file, which are not the schema's."""
    with np.load(real("real/ble-hall-2.npz")) as stored:
        write_raw(tmp_path / "hall.npz", Raw(dict(stored), {}, {"mobile_position": "mm"}))
    refused(
        "tx_position: units are 'mm'; expected 'm'", lambda path: read_any(path).data, tmp_path / "hall.npz"
    )

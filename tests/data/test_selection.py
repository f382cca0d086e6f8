"""Parts of a campaign: which rows and links stay, what is said of the others, which settings cannot be."""
# ruff: noqa: E501 (a case is a row of a table)

import numpy as np
import pytest
from measured import ble_arrays, techtile_arrays
from releases import real

from gsparc.data import selection
from gsparc.data.own import from_arrays
from gsparc.data.raw import Raw, read_raw
from gsparc.data.selection import Selection, keep_above, keep_rows, keep_runs, keep_stations, select


def wide() -> Raw:
    """Fifteen places heard by four named stations, with two values missing."""
    arrays = ble_arrays()
    arrays["rssi_db"][[2, 5], [1, 3]] = np.nan
    names = {"mobile_position": "tx_position", "station": "station_name", "frequency_hz": "carrier_hz"}
    return Raw({names.get(name, name): array for name, array in arrays.items()}, {}, {"tx_position": "m"})


def long() -> Raw:
    """The same, one row per link."""
    arrays = dict(wide().arrays)
    rows, count = arrays["rssi_db"].shape
    arrays["tx_position"] = np.repeat(arrays["tx_position"], count, axis=0)
    arrays["station"] = np.tile(np.arange(count), rows)
    arrays["rssi_db"] = arrays["rssi_db"].ravel()
    return Raw(arrays)


def channels() -> Raw:
    """Twelve places in two runs."""
    arrays = techtile_arrays()
    return Raw({"station_position" if n == "rx_antenna_position" else n: a for n, a in arrays.items()})


def plain(rows: int = 40, **more: np.ndarray) -> Raw:
    """Powers of one link per row; row i is at x = i."""
    places = np.stack([np.arange(rows), np.zeros(rows), np.ones(rows)], axis=1)
    return Raw({"rx_position": places, "rssi_db": -40.0 - np.arange(rows), **more})


def test_stations_of_a_wide_file_are_columns():
    raw = wide()
    kept = keep_stations(raw, ["sensor42", 1, "sensor42"], "file")
    assert kept.raw.arrays["station_name"].tolist() == ["sensor11", "sensor42"]
    assert np.array_equal(kept.raw.arrays["rssi_db"], raw.arrays["rssi_db"][:, [1, 3]], equal_nan=True)
    assert np.array_equal(kept.raw.arrays["station_position"], raw.arrays["station_position"][[1, 3]])
    assert kept.raw.arrays["tx_position"] is raw.arrays["tx_position"]
    assert kept.raw.units == raw.units and kept.notes == ("dataset.stations: 2 of 4 stations left out",)


def test_stations_of_a_long_file_are_rows_and_numbered_anew():
    raw, kept = long(), keep_stations(long(), ["sensor11", "sensor42"], "file")
    rows = np.isin(raw.arrays["station"], [1, 3])
    assert np.array_equal(kept.raw.arrays["rssi_db"], raw.arrays["rssi_db"][rows], equal_nan=True)
    assert np.array_equal(kept.raw.arrays["station"], np.tile([0, 1], 15))
    assert kept.notes[1] == "dataset.stations: 30 of 60 rows left out"


@pytest.mark.parametrize("make", [channels, long])
def test_antenna_5_of_a_part_of_them_answered_as_1(make):
    """`dataset.stations=[0,5]` made stations "0" and "1" of a file without names."""
    raw = make()
    raw.arrays.pop("station_name", None)
    last = len(raw.arrays["station_position"]) - 1
    data = from_arrays(select(raw, Selection(stations=[0, last]), "file").raw.arrays)
    assert data.site.stations.name == ("0", str(last))


def test_what_belongs_to_a_station_goes_with_it():
    more = {
        "sensitivity_db": np.arange(4.0), "carrier_hz": 1e9 + np.arange(4.0), "mask": np.ones((15, 4), bool),
    }  # fmt: skip
    kept = keep_stations(Raw({**wide().arrays, **more}), [2, 0], "file").raw.arrays
    assert kept["sensitivity_db"].tolist() == [0, 2] and kept["carrier_hz"].tolist() == [1e9, 1e9 + 2]
    assert kept["mask"].shape == (15, 2)


def test_carriers_of_as_many_rows_as_stations_were_taken_by_station():
    """Read whole they are of rows; with a station left out, rows had those of other rows."""
    first = {name: long().arrays[name][:4] for name in ("tx_position", "rssi_db")}
    of_rows = {"station": np.array([0, 0, 1, 2]), "carrier_hz": 1e9 + np.arange(4.0)}
    kept = keep_stations(Raw({**long().arrays, **first, **of_rows}), [0, 2], "file").raw.arrays
    assert kept["station"].tolist() == [0, 0, 1] and (kept["carrier_hz"] - 1e9).tolist() == [0, 1, 3]


def test_runs_are_rows():
    kept = keep_runs(channels(), ["EXP006"], "file")
    assert set(kept.raw.arrays["run"]) == {"EXP006"}
    assert kept.raw.arrays["csi"].shape == (4, 3) and kept.raw.arrays["mask"].shape == (4, 3)
    assert kept.raw.arrays["station_position"].shape == (3, 3)
    assert kept.notes == ("dataset.runs=EXP006: 8 of 12 rows left out",)
    numbered = Raw({**channels().arrays, "run": np.repeat([5, 6], [8, 4])})
    assert [len(keep_runs(numbered, [run], "file").raw.arrays["csi"]) for run in (5, "6")] == [8, 4]


def test_low_powers_of_single_links_are_rows_left_out():
    kept = keep_above(plain(), -50, "file")
    assert kept.raw.arrays["rssi_db"].min() == -50 and len(kept.raw.arrays["rx_position"]) == 11
    assert kept.notes == ("dataset.min_rssi_db=-50: 29 of 40 rows left out",)
    linear = Raw(
        {"rx_position": plain().arrays["rx_position"], "rssi": 10 ** (plain().arrays["rssi_db"] / 10)}
    )
    assert len(keep_above(linear, -50.0001, "file").raw.arrays["rssi"]) == 11


def test_low_powers_of_a_wide_file_are_not_measured():
    raw = wide()
    level = float(np.nanquantile(raw.arrays["rssi_db"], 0.1))
    kept = keep_above(raw, level, "file").raw.arrays
    with np.errstate(invalid="ignore"):
        assert np.array_equal(kept["mask"], raw.arrays["rssi_db"] >= level)
    assert np.array_equal(kept["rssi_db"], raw.arrays["rssi_db"], equal_nan=True)


def test_a_fault_is_not_a_signal_below_the_sensitivity():
    """NaN stays for the reader to take as not heard; what was left out is masked."""
    raw = Raw({**wide().arrays, "sensitivity_db": np.array(-100.0)})
    level = float(np.nanquantile(raw.arrays["rssi_db"], 0.1))
    mask = keep_above(raw, level, "file").raw.arrays["mask"]
    unheard = np.isnan(raw.arrays["rssi_db"])
    assert mask[unheard].all() and not mask[raw.arrays["rssi_db"] < level].any()


def test_a_place_that_nobody_heard_loud_enough_is_left_out():
    raw = wide()
    raw.arrays["rssi_db"][4] = -200
    kept = keep_above(raw, -150, "file")
    assert len(kept.raw.arrays["rssi_db"]) == 14 and kept.raw.arrays["mask"].shape == (14, 4)
    assert kept.notes[0].endswith("4 links left out") and kept.notes[1].endswith("1 of 15 rows left out")


def test_fewer_rows_cover_the_campaign():
    rows = keep_rows(plain(1000), 100, "file").raw.arrays["rx_position"][:, 0]
    assert len(rows) == 100 and (rows // 10).tolist() == list(range(100))
    assert len(set(rows % 10)) > 5  # not in step with a raster of ten columns
    again = keep_rows(plain(1000), 100, "file").raw.arrays["rx_position"][:, 0]
    assert np.array_equal(rows, again)


@pytest.mark.parametrize("most", [2, 7, 39, 40])
def test_the_number_of_rows_is_met(most):
    kept = keep_rows(plain(40), most, "file")
    assert len(kept.raw.arrays["rssi_db"]) == most
    notes = (f"dataset.max_rows={most}: {40 - most} of 40 rows left out",)
    assert kept.notes == (notes if most < 40 else ())


def take_rows(raw: Raw, rows: np.ndarray) -> dict[str, np.ndarray]:
    return selection.take_rows(raw.arrays, rows, len(raw.arrays["rssi_db"]))


def test_the_file_s_split_follows_its_rows():
    raw = plain(10, split_train=np.arange(7), split_test=np.array([9, 8, 7]))
    kept = take_rows(raw, np.array([1, 3, 8, 9]))
    assert kept["split_train"].tolist() == [0, 1] and kept["split_test"].tolist() == [2, 3]
    assert "split_train" not in take_rows(raw, np.array([1, 3]))


def test_paths_follow_their_rows():
    raw = plain(
        4, path_offsets=np.array([0, 2, 2, 5, 6]), path_gain=np.arange(6.0),
        path_last_point=np.arange(18.0).reshape(6, 3),
    )  # fmt: skip
    kept = take_rows(raw, np.array([0, 2]))
    assert kept["path_offsets"].tolist() == [0, 2, 5] and kept["path_gain"].tolist() == [0, 1, 2, 3, 4]
    assert kept["path_last_point"].shape == (5, 3)


CANNOT = {
    "misspelt station": (wide, {"stations": ["senor42"]}, "no station senor42 in file; did you mean 'sensor42'?"),
    "station beyond the last": (wide, {"stations": [4]}, "dataset.stations=4: file has stations 0 to 3"),
    "name without names": (channels, {"stations": ["A05"]}, "dataset.stations=A05: file has stations 0 to 2"),
    "no stations": (plain, {"stations": [0]}, "file has no stations; expected station_position"),
    "misspelt run": (channels, {"runs": ["EXP05"]}, "no such run in file; did you mean 'EXP005'?"),
    "no runs": (wide, {"runs": ["EXP005"]}, "file names no runs; expected an array run"),
    "no powers": (channels, {"min_rssi_db": -80}, "file holds csi; expected powers"),
    "all below": (wide, {"min_rssi_db": 0}, "dataset.min_rssi_db=0: 0 rows of file are left"),
    "level in words": (plain, {"min_rssi_db": "low"}, "min_rssi_db='low': a number, or null is needed"),
    "no rows": (plain, {"max_rows": 0}, "max_rows=0: a whole number of at least 2, or null is needed"),
    "no measurement": (lambda: Raw({"rx_position": np.zeros((3, 3))}), {"max_rows": 2}, "found none of them"),
    "no steps": (wide, {"level_steps": {"sensor11": []}}, "first rows after steps by station"),
    "columns of other stations": (
        lambda: Raw({**wide().arrays, "rssi_db": np.zeros((15, 5))}), {"stations": [0]},
        "rssi_db: expected a column for each of the 4 stations",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CANNOT)
def test_what_cannot_be_is_one_line(refused, case):
    make, settings, says = CANNOT[case]
    refused(says, lambda: select(make(), Selection(**settings), "file"))


def test_one_name_needs_no_brackets():
    assert Selection(stations="A05").stations == ("A05",) and Selection(runs=3).runs == (3,)
    assert Selection(level_steps={"b": 5, 3: [6, 7]}).level_steps == {"b": (5,), "3": (6, 7)}


def test_the_faulty_rows_of_the_measured_plane():
    path = real("real/techtile-power-reci-rf-1.npz")
    raw = read_raw(path)
    kept = select(raw, Selection(min_rssi_db=-75, max_rows=5000), path)
    assert kept.notes[0] == "dataset.min_rssi_db=-75: 73 of 20382 rows left out"
    assert kept.raw.arrays["rssi_db"].min() > -75 and len(kept.raw.arrays["rx_position"]) == 5000
    # Fewer rows reach as far as all do, in centimetres.
    for end in (np.min, np.max):
        whole, part = (end(r.arrays["rx_position"][:, :2], axis=0) for r in (raw, kept.raw))
        assert np.abs(whole - part).max() < 0.03

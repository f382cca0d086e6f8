"""Parts of a campaign: which rows and links stay, what is said of the others,
which settings cannot be.
"""

import numpy as np
import pytest
from measured import ble_arrays, techtile_arrays

from gsparc.data import selection
from gsparc.data.schema import Measurements
from gsparc.data.selection import Selection
from gsparc.tables.own import Reading, interpret
from gsparc.tables.raw import Raw


def part(raw: Raw, **settings) -> Reading:
    return interpret(raw, "file", Selection(**settings))


def level(data: Measurements) -> np.ndarray:
    """As measured [dB]."""
    return 10 * np.log10(data.target[:, 0] * data.site.target_scale)


def left_out(reading: Reading) -> list[str]:
    return [note for note in reading.notes if note.startswith("dataset.")]


def wide() -> Raw:
    """Fifteen places heard by four named stations, with two values missing."""
    arrays = ble_arrays()
    arrays["rssi_db"][[2, 5], [1, 3]] = np.nan
    names = {
        "mobile_position": "tx_position",
        "station": "station_name",
        "frequency_hz": "carrier_hz",
    }
    return Raw(
        {names.get(name, name): array for name, array in arrays.items()}, {}, {"tx_position": "m"}
    )


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
    return Raw(
        {"station_position" if n == "rx_antenna_position" else n: a for n, a in arrays.items()}
    )


def plain(rows: int = 40, **more: np.ndarray) -> Raw:
    """Powers of one link per row; row i is at x = i."""
    places = np.stack([np.arange(rows), np.zeros(rows), np.ones(rows)], axis=1)
    return Raw({"rx_position": places, "rssi_db": -40.0 - np.arange(rows), **more})


@pytest.mark.parametrize("make", [wide, long])
def test_stations_are_columns_of_a_wide_file_and_rows_of_a_long_one(make):
    read = part(make(), stations=["sensor42", 1, "sensor42"])
    stations = read.data.site.stations
    assert stations.name == ("sensor11", "sensor42")
    where = make().arrays["station_position"][[1, 3]]
    np.testing.assert_allclose(stations.position + read.data.site.origin, where)
    values = wide().arrays["rssi_db"][:, [1, 3]].ravel()
    np.testing.assert_allclose(level(read.data), values[~np.isnan(values)], atol=1e-4)
    assert np.array_equal(read.data.station, np.tile([0, 1], 15)[~np.isnan(values)])
    assert left_out(read) == ["dataset.stations: 30 of 60 rows left out"]


@pytest.mark.parametrize("make", [channels, long])
def test_antenna_5_of_a_part_of_them_answered_as_1(make):
    """`dataset.stations=[0,5]` made stations "0" and "1" of a file without names."""
    raw = make()
    raw.arrays.pop("station_name", None)
    last = len(raw.arrays["station_position"]) - 1
    assert part(raw, stations=[0, last]).data.site.stations.name == ("0", str(last))


def test_what_belongs_to_a_station_goes_with_it():
    more = {"sensitivity_db": -200 - np.arange(4.0), "carrier_hz": 1e9 * (1 + np.arange(4.0))}
    data = part(Raw({**wide().arrays, **more}), stations=[2, 0]).data
    assert data.site.stations.carrier_hz.tolist() == [1e9, 3e9]
    silent = Raw({**wide().arrays, "sensitivity_db": -200 - np.arange(4.0)})
    unheard = part(silent, stations=["sensor42", "sensor11"]).data
    assert level(unheard)[unheard.censored == 1].tolist() == pytest.approx([-201, -203], abs=1e-3)


def test_carriers_of_as_many_rows_as_stations_were_taken_by_station():
    """Read whole they are of rows; with a station left out, rows had those of other rows."""
    first = {name: long().arrays[name][:4] for name in ("tx_position", "rssi_db")}
    first["tx_position"] = first["tx_position"] + np.arange(4)[:, None]
    of_rows = {"station": np.array([0, 0, 1, 2]), "carrier_hz": 1e9 * (1 + np.arange(4.0))}
    stations = part(Raw({**long().arrays, **first, **of_rows}), stations=[0, 2]).data.site.stations
    assert stations.carrier_hz.tolist() == [1e9, 2e9, 4e9]


def test_low_powers_are_left_out():
    read = part(plain(), min_rssi_db=-50)
    assert level(read.data).min() == pytest.approx(-50, abs=1e-4) and len(read.data) == 11
    assert left_out(read) == ["dataset.min_rssi_db=-50: 29 of 40 rows left out"]
    powers = {**plain().arrays, "rssi": 10 ** (plain().arrays["rssi_db"] / 10)}
    del powers["rssi_db"]
    assert len(part(Raw(powers), min_rssi_db=-50.0001).data) == 11
    everywhere, least = (
        wide().arrays["rssi_db"],
        float(np.nanquantile(wide().arrays["rssi_db"], 0.1)),
    )
    assert len(part(wide(), min_rssi_db=least).data) == (everywhere >= least).sum()


def test_a_fault_is_not_a_signal_below_the_sensitivity():
    """NaN is not heard; what was left out is not measured."""
    raw = Raw({**wide().arrays, "sensitivity_db": np.array(-200.0)})
    least = float(np.nanquantile(raw.arrays["rssi_db"], 0.1))
    data = part(raw, min_rssi_db=least).data
    assert (data.censored == 1).sum() == 2 and level(data)[data.censored == 0].min() >= least - 1e-4


@pytest.mark.parametrize("most", [2, 7, 39, 40])
def test_the_number_of_rows_is_met(most):
    read = part(plain(40), max_rows=most)
    assert len(read.data) == most
    notes = [f"dataset.max_rows={most}: {40 - most} of 40 rows left out"]
    assert left_out(read) == (notes if most < 40 else [])
    assert len(np.unique(part(wide(), max_rows=5).data.place)) == 5  # places of a wide file


def take_rows(raw: Raw, rows: np.ndarray) -> dict[str, np.ndarray]:
    return selection.take_rows(raw.arrays, rows, len(raw.arrays["rssi_db"]))


def test_the_file_s_split_follows_its_rows():
    raw = plain(10, split_train=np.arange(7), split_test=np.array([9, 8, 7]))
    kept = take_rows(raw, np.array([1, 3, 8, 9]))
    assert kept["split_train"].tolist() == [0, 1] and kept["split_test"].tolist() == [2, 3]
    assert "split_train" not in take_rows(raw, np.array([1, 3]))


def test_paths_follow_their_rows():
    raw = plain(
        4,
        path_offsets=np.array([0, 2, 2, 5, 6]),
        path_gain=np.arange(6.0),
        path_last_point=np.arange(18.0).reshape(6, 3),
    )
    kept = take_rows(raw, np.array([0, 2]))
    assert kept["path_offsets"].tolist() == [0, 2, 5] and kept["path_gain"].tolist() == [
        0,
        1,
        2,
        3,
        4,
    ]
    assert kept["path_last_point"].shape == (5, 3)


CANNOT = {
    "misspelt station": (
        wide,
        {"stations": ["senor42"]},
        "no station senor42 in file; did you mean 'sensor42'?",
    ),
    "station beyond the last": (
        wide,
        {"stations": [4]},
        "dataset.stations=4: no station 4 in file",
    ),
    "name without names": (
        channels,
        {"stations": ["A05"]},
        "dataset.stations=A05: no station A05 in file; there are 0, 1, 2",
    ),
    "a table of them": (
        wide,
        {"stations": [__file__]},
        f"; a table of them is dataset.stations_file={__file__}",
    ),
    "no stations": (plain, {"stations": [0]}, "file has no stations; expected station_position"),
    "misspelt run": (channels, {"runs": ["EXP05"]}, "did you mean 'EXP005'?"),
    "no runs": (wide, {"runs": ["EXP005"]}, "file names no runs; expected an array run"),
    "no powers": (channels, {"min_rssi_db": -80}, "file holds csi; expected powers"),
    "all below": (plain, {"min_rssi_db": 0}, "dataset.min_rssi_db=0: 0 rows of file are left"),
    "all of several below": (wide, {"min_rssi_db": 0}, "rssi_db: nothing was measured"),
    "level in words": (
        plain,
        {"min_rssi_db": "low"},
        "min_rssi_db='low': a number, or null is needed",
    ),
    "no rows": (
        plain,
        {"max_rows": 0},
        "max_rows=0: a whole number of at least 2, or null is needed",
    ),
    "no measurement": (
        lambda: Raw({"rx_position": np.zeros((3, 3))}),
        {"max_rows": 2},
        "found none of them",
    ),
    "no steps": (wide, {"level_steps": {"sensor11": []}}, "first rows after steps by station"),
    "columns of other stations": (
        lambda: Raw({**wide().arrays, "rssi_db": np.zeros((15, 5))}),
        {"stations": [0]},
        "rssi_db: expected shape (S, 4, ...), a column for each station",
    ),
}


@pytest.mark.parametrize("case", CANNOT)
def test_what_cannot_be_is_one_line(refused, case):
    make, settings, says = CANNOT[case]
    refused(says, lambda: part(make(), **settings))

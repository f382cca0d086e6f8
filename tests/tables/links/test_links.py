"""Stations, both ends moving, missing and censored powers: what a file may say,
and what it becomes.
"""

import re

import numpy as np
import pytest

from gsparc.base.errors import DataError
from gsparc.base.limits import SettingError
from gsparc.data.selection import Selection
from gsparc.tables.checks.plausibility import unit_warnings
from gsparc.tables.own import from_arrays, interpret
from gsparc.tables.raw import Raw

PLACES, STATIONS = 10, 3
RNG = np.random.default_rng(0)
WALK = RNG.uniform(0, 20, (PLACES, 3))
POSTS = np.array([[0.0, 0, 5], [20, 0, 5], [0, 20, 5]])
LEVELS = RNG.uniform(-90, -40, (PLACES, STATIONS))
LONG = {
    "tx_position": np.repeat(WALK, STATIONS, axis=0),
    "station": np.tile(np.arange(STATIONS), PLACES),
}


def town(**changes):
    """Powers of a walking transmitter at three stations, one column for each."""
    arrays = {
        "tx_position": WALK,
        "station_position": POSTS,
        "station_name": np.array(["north", "east", "roof"]),
        "rssi_db": LEVELS,
    }
    return {k: np.asarray(v) for k, v in {**arrays, **changes}.items() if v is not None}


def degrees(latitude, longitude, **changes):
    places = {
        "tx_position": None,
        "station_position": None,
        "latitude": latitude,
        "longitude": longitude,
    }
    return town(**{**places, **changes})


def read(arrays):
    return interpret(Raw(dict(arrays)), "town.npz")


def test_a_wide_file_is_a_row_for_each_link():
    data = read(town()).data
    assert len(data) == PLACES * STATIONS and data.site.static_end == "rx"
    assert (
        data.site.stations.name == ("north", "east", "roof") and data.site.static_position is None
    )
    link = 4 * STATIONS + 2
    assert (
        data.station[link] == 2
        and data.place[link] == 4
        and data.row_names[link] == "row 4, station roof"
    )
    np.testing.assert_allclose(data.tx[link] + data.site.origin, WALK[4])
    np.testing.assert_allclose(data.rx_position[link] + data.site.origin, POSTS[2])
    np.testing.assert_allclose(
        10 * np.log10(data.target[link, 0] * data.site.target_scale), LEVELS[4, 2], atol=1e-3
    )


def test_three_access_points_by_their_positions_alone():
    """One end at three places was refused: both ends move."""
    rows = 60
    which = np.arange(rows) % 3
    walk = RNG.uniform(0, 20, (rows, 3))
    found = read(
        {"rx_position": walk, "tx_position": POSTS[which], "rssi_db": RNG.uniform(-80, -40, rows)}
    )
    assert len(found.data.site.stations) == 3 and found.data.site.static_end == "tx"
    assert any("taken as 3 stations" in note for note in found.notes)


def test_missing_powers_are_no_rows_and_are_counted():
    """A mask over missing powers was advised and then refused."""
    holes = LEVELS.copy()
    holes[[1, 2, 5], [0, 0, 2]] = np.nan
    found = read(town(rssi_db=holes))
    assert len(found.data) == PLACES * STATIONS - 3 and found.data.censored is None
    assert "3 of 30 values are missing" in found.notes[0]
    masked = read(town(mask=np.isfinite(holes)))
    np.testing.assert_array_equal(masked.data.station, found.data.station)


def test_levels_below_the_sensitivity_were_refused():
    """Noise that a receiver reports is no signal;
    a station without a level was refused beside them.
    """
    holes = np.where(LEVELS < -80, np.nan, LEVELS)
    told = {"station_position": POSTS, "sensitivity_db": np.array([-80.0, np.nan, -80.0])}
    for station, arrays in ((1, town(rssi_db=holes, **told)), (None, town(sensitivity_db=-80.0))):
        found = read(arrays)
        silent = (LEVELS < -80) & (np.arange(STATIONS) != station)
        assert (found.data.censored > 0).sum() == silent.sum()
        assert (found.data.mask[:, 0] == (found.data.censored == 0)).all()
        level = 10 * np.log10(
            found.data.target[found.data.censored > 0] * found.data.site.target_scale
        )
        np.testing.assert_allclose(level, -80, atol=1e-3)
    assert any(
        "levels lie below sensitivity_db: taken as not heard; has it the" in n for n in found.notes
    )


def test_carriers_that_could_be_of_rows_or_stations_were_taken_without_a_word():
    three = town(
        **{k: v[:3] for k, v in town().items() if isinstance(v, np.ndarray) and len(v) == PLACES}
    )
    found = read({**three, "carrier_hz": np.array([4e8, 5e8, 6e8])})
    assert any("carrier_hz: as many values as rows and as stations" in note for note in found.notes)


SPOILT = {
    "station out of range": (
        town(station=np.full(PLACES, 3), rssi_db=LEVELS[:, 0]),
        "row 0 is of station 3",
    ),
    "station by name": (
        town(station=np.full(PLACES, "roof"), rssi_db=LEVELS[:, 0]),
        "whole numbers",
    ),
    "columns": (
        town(rssi_db=LEVELS[:, :2]),
        r"expected shape \(S, 3, ...\), a column for each station",
    ),
    "names": (town(station_name=np.array(["a", "a", "b"])), "'a' twice"),
    "fewer names": (
        town(station_name=np.array(["a", "b"])),
        r"station_name: expected shape \(T,\)",
    ),
    "nan station": (town(station_position=POSTS * [1, np.nan, 1]), "station_position, row 0"),
    "no height": (town(tx_position=WALK[:, :2]), "two coordinates; expected .* as tx_height"),
    "height of 3-D": (town(tx_height=1.5), "tx_height: given, but tx_position has three"),
    "both ends and stations": (town(rx_position=WALK), "found rx_position and tx_position"),
    "no end": (town(tx_position=None), "of the end that moves; found neither"),
    "no table": (
        town(station_position=None, station=np.zeros(PLACES, int)),
        "without station_position",
    ),
    "all missing": (town(rssi_db=LEVELS * np.nan), "nothing was measured"),
    "all below the level": (town(sensitivity_db=-20.0), "nothing was heard in any row"),
    "level of channels": (
        town(rssi_db=None, rssi=LEVELS**2, sensitivity_db=-80.0),
        "goes with rssi_db",
    ),
    "level of 1e9": (town(sensitivity_db=1e9), "expected dB between -400 and 400"),
    "turned transmitters": (
        town(tx_position=None, rx_position=WALK, station_orientation=np.eye(4)[:3]),
        "are not turned",
    ),
    "orientation": (town(station_orientation=np.ones((3, 4))), "north = .*: expected a quaternion"),
    "mask of another shape": (town(mask=np.ones(PLACES, bool)), "mask: expected shape"),
    "NaN under a mask": (
        town(rssi_db=LEVELS * np.nan, mask=np.ones_like(LEVELS, bool)),
        "not finite",
    ),
    "carriers in MHz": (town(carrier_hz=np.array([460.0, 461, 462])), r"expected Hz"),
    "latitude alone": (town(tx_position=None, latitude=np.full(PLACES, 40.0)), "given alone"),
    "beyond the pole": (
        degrees(np.full(PLACES, 140.0), np.full(PLACES, 4.0)),
        "row 0: latitude 140",
    ),
    "counts of degrees": (degrees(WALK[:, 0], WALK[1:, 1]), "here .10,., found .9,"),
    "metres beside degrees": (
        degrees(WALK[:, 0], WALK[:, 1], station_position=POSTS),
        "in metres beside places in degrees",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_what_is_wrong_is_one_line(refused, case):
    arrays, says = SPOILT[case]
    refused(says, read, arrays)


def changed(array, *changes):
    """The array with other values at some indices."""
    array = array.copy()
    for index, value in changes:
        array[index] = value
    return array


OF_ROWS = [
    (
        {
            "rx_position": WALK,
            "tx_position": POSTS[0],
            "rssi_db": changed(LEVELS[:, 0], (3, np.nan), (7, np.inf)),
        },
        "rssi_db, row 7: not finite",
    ),
    (
        town(**LONG, rssi_db=changed(LEVELS.reshape(-1), (17, np.inf))),
        "rssi_db, row 17, station roof: not finite",
    ),
]


@pytest.mark.parametrize(("arrays", "says"), OF_ROWS)
def test_messages_name_the_rows_of_the_file(refused, arrays, says):
    """Rows were counted after those without a value were gone, or places, or links were."""
    refused(says, read, arrays)


def test_rows_keep_their_numbers_when_a_part_is_taken():
    """What was selected was counted from 0 again: a message named another row than the file's."""
    raw = Raw(town(run=np.array(["a"] * 4 + ["b"] * 6)))
    part = interpret(raw, "town.npz", Selection(runs=["b"], stations=["roof"]))
    assert part.data.row_names == [f"row {i}, station roof" for i in range(4, 10)]


def test_a_level_for_each_station_was_refused_where_stations_have_two_carriers():
    levels_db = np.where(LEVELS < -80, np.nan, LEVELS)
    carriers = np.where(np.arange(PLACES) % 2, 1e9, 2e9)
    data = read(
        town(rssi_db=levels_db, carrier_hz=carriers, sensitivity_db=np.array([-80.0, -81, -82]))
    ).data
    assert len(data.site.stations) == 2 * STATIONS and data.censored.any()
    assert data.site.stations.name[:2] == ("north at 1000 MHz", "north at 2000 MHz")
    assert data.site.stations.carrier_hz[data.station[-1]] == 1e9
    level_db = 10 * np.log10(data.target[:, 0].astype(float) * data.site.target_scale)
    expected = [
        {"n": -80.0, "e": -81.0, "r": -82.0}[data.site.stations.name[t][0]] for t in data.station
    ]
    np.testing.assert_allclose(
        level_db[data.censored > 0], np.array(expected)[data.censored > 0], atol=1e-3
    )


def test_powers_of_zero_were_learned_as_300_dB_below():
    """Nobody said that; now they are not heard, below the weakest that was."""
    powers = np.where(LEVELS < -80, 0.0, 10 ** (LEVELS / 10))
    found = read({**town(rssi_db=None), "rssi": powers})
    assert (found.data.censored == 1).sum() == (powers == 0).sum() > 0
    assert (f"{(powers == 0).sum()} of {powers.size} powers were not heard: below") in " ".join(
        found.notes
    )
    bounds = 10 * np.log10(
        found.data.target[found.data.censored == 1].astype(float) * found.data.site.target_scale
    )
    np.testing.assert_allclose(bounds, LEVELS[LEVELS >= -80].min(), atol=1e-3)
    assert not unit_warnings(found.data)


def test_nothing_heard_in_any_row_was_zero_everywhere(refused):
    """It said that every measured value is zero."""
    arrays = {
        "rx_position": np.eye(3) * 4,
        "rssi_db": np.full(3, np.nan),
        "sensitivity_db": np.array(-100.0),
    }
    refused("rssi_db: nothing was heard in any row", read, arrays)


@pytest.mark.parametrize("what", ["masked", "dark"])
def test_rows_that_tell_nothing_were_refused(what):
    """A mask without an entry, or a spectrum without any power, is no row."""
    spectra = RNG.uniform(0.1, 1, (PLACES, 12, 24))
    arrays = {"tx_position": WALK, "rx_position": POSTS[0], "spectrum": spectra}
    if what == "masked":
        arrays["mask"] = np.ones(spectra.shape, bool)
        arrays["mask"][3] = False
    else:
        spectra[3] = 0
    found = interpret(Raw(arrays, {}), "own")
    assert len(found.data) == PLACES - 1 and any(
        "1 of 10 values are missing" in note for note in found.notes
    )
    assert np.allclose(found.data.tx + found.data.site.origin, np.delete(WALK, 3, 0))


def test_one_station_in_degrees_needed_a_column():
    degrees = {
        "latitude": 48 + WALK[:, 1] / 1e5,
        "longitude": 9 + WALK[:, 0] / 1e5,
        "tx_height": WALK[:, 2],
    }
    mast = {
        "station_latitude": np.array([48.0]),
        "station_longitude": np.array([9.0]),
        "station_height": np.array(5.0),
    }
    found = interpret(Raw({**degrees, **mast, "rssi_db": LEVELS[:, 0]}, {}), "own")
    assert len(found.data) == PLACES and len(found.data.site.stations) == 1


@pytest.mark.parametrize(
    "said", [{"not_heard": "none"}, {"not_heard": [-999, "x"]}, {"absent": "silnt"}]
)
def test_what_is_said_of_unheard_powers_was_not_checked(said):
    """An attribute of text was a traceback; a mark that is no level, or a mistyped word,
    counted as none.
    """
    with pytest.raises(SettingError, match=f"dataset.{next(iter(said))}="):
        interpret(Raw(town(), said), "town.npz")
    levels = np.where(np.arange(PLACES) < 4, -np.inf, LEVELS[:, 0])
    marked = Raw(
        town(rssi_db=levels, station_position=POSTS[:1], station_name=None),
        {"not_heard": [-np.inf]},
    )
    assert (interpret(marked, "town.npz").data.censored == 1).sum() == 4


def test_whole_numbers_beside_a_sensitivity_were_a_traceback():
    whole = LEVELS.round().astype(np.int64)
    data = read(town(rssi_db=whole, sensitivity_db=np.array(-99.0))).data
    assert np.allclose(
        10 * np.log10(data.target[:, 0] * data.site.target_scale), whole.ravel(), atol=1e-4
    )


FORMS = {  # arrays and attributes, and what is said of them
    "stations of two counts": (
        degrees(
            *(WALK[:, :2] / 1e4 + 40).T,
            rx_height=1.0,
            station_latitude=POSTS[:, 0],
            station_longitude=POSTS[:2, 0],
        ),
        {},
        "station_longitude: expected",
    ),
    "no levels": (
        town(rssi_db=np.array(3.0)),
        {},
        r"rssi_db: expected shape \(S,\) or \(S, T\), found \(\)",
    ),
    "text": (town(rssi_db=LEVELS.astype(str)), {}, "rssi_db: expected real numbers"),
    "times as places": (
        town(tx_position=WALK.astype("M8[s]")),
        {},
        "tx_position: expected real numbers",
    ),
    "a name of two": (town(), {"name": np.array([1.0, 2.0])}, "name: a list; expected text"),
    "a measurement of two": (
        town(),
        {"measurement": np.array(["rssi", "csi"])},
        "names no measurement",
    ),
    "transposed powers": (
        town(),
        {"conventions": "transposed"},
        "transposed: rows as azimuths, columns as",
    ),
}


@pytest.mark.parametrize("case", FORMS)
def test_arrays_and_attributes_of_another_form_were_tracebacks(case):
    arrays, attributes, says = FORMS[case]
    with pytest.raises(DataError) as caught:
        interpret(Raw(arrays, attributes), "town.npz")
    assert any(re.search(says, line) for line in caught.value.problems), caught.value.problems


def test_a_carrier_per_row_was_refused_without_a_list_of_stations():
    """One receiver whose rows are at two carriers is a station at each;
    rows of a place stay together.
    """
    places = np.repeat(np.random.default_rng(0).uniform(0, 5, (12, 3)), 2, axis=0)
    spectra = np.random.default_rng(1).uniform(0, 1, (24, 12, 24))
    arrays = {"tx_position": places, "rx_position": np.zeros(3), "spectrum": spectra}
    data = from_arrays(arrays | {"carrier_hz": np.tile([1e9, 60e9], 12)})
    assert data.carrier_hz.tolist() == [1e9, 60e9] * 12 and data.site.static_end == "rx"
    assert data.place.tolist() == np.repeat(np.arange(12), 2).tolist()
    assert data.site.stations.name == ("rx at 1000 MHz", "rx at 60000 MHz")
    alike = from_arrays(arrays | {"carrier_hz": np.full(24, 2e9)})
    assert alike.site.stations is None and alike.site.carrier_hz == 2e9

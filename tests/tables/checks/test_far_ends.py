"""Static ends that cannot be of the rows: swapped axes, another system, heights above the sea."""

import numpy as np
import pytest

from gsparc.base.errors import DataError
from gsparc.tables.own import Reading, interpret
from gsparc.tables.raw import Raw


def reading(**change: np.ndarray) -> Reading:
    rng = np.random.default_rng(0)
    arrays = {
        "latitude": rng.uniform(48.1, 48.12, 40),
        "longitude": rng.uniform(11.5, 11.53, 40),
        "rx_height": np.array(1.5),
        "rssi_db": rng.uniform(-90, -60, 40),
        "station": np.arange(40) % 2,
        "station_latitude": np.array([48.11, 48.12]),
        "station_longitude": np.array([11.52, 11.51]),
        "station_height": np.array(30.0),
    }
    arrays |= change
    return interpret(
        Raw({name: array for name, array in arrays.items() if array is not None}), "drive"
    )


def test_stations_thousands_of_kilometres_from_all_rows_were_good(refused):
    """Rows with latitude and longitude swapped, 5,285 km from their stations."""
    there = reading()
    rows = {
        "latitude": there.data.rx_position[:, 0] * 0 + 11.5,
        "longitude": np.linspace(48.1, 48.12, 40),
    }
    for change in (
        rows,
        {"station_latitude": np.array([11.52, 11.51]), "station_longitude": np.full(2, 48.1)},
    ):
        refused(r"km from all rows.*are latitude and longitude swapped\?", reading, **change)
    with pytest.raises(DataError, match=r"km from all rows.*in one system and unit\?"):
        reading(
            **rows, station_longitude=np.array([11.52, -60.0]), station_latitude=np.full(2, 48.0)
        )
    (said,) = [
        note
        for note in reading(station_latitude=np.array([49.2, 48.1])).notes
        if "static end" in note
    ]
    assert "120" in said and "km from all rows" in said


def test_heights_above_the_sea_and_above_the_ground_were_good():
    (said,) = [note for note in reading(rx_height=np.array(520.0)).notes if "static end" in note]
    assert "490 m below all rows: heights above the sea beside heights above the ground?" in said


def test_stations_below_the_ground_are_named():
    """A height of -25 m was good."""
    (said,) = [note for note in reading(station_height=np.array(-25.0)).notes if "below 0" in note]
    assert said.startswith("a static end at a height of -25 m")


def test_heights_of_stations_in_kilometres_are_named():
    (said,) = [
        note for note in reading(station_height=np.array(0.025)).notes if "static ends" in note
    ]
    assert said == "static ends at heights of 0.025 m at most: in kilometres?"

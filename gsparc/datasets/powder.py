"""Received powers of a walking transmitter at fixed stations
of a campus (POWDER, University of Utah).

The release is a table, `single_tx.csv`: a row per place with `timestamp`, one column per station
[dB], columns `bus-*` of stations that drive (left out), and the transmitter's `tx_x_coord`
(latitude!) and `tx_y_coord` (longitude) [deg]; -101 stands for no value.
`location_coordinates.json` beside it has the stations' places. The carrier is 462.7 MHz.

The same as an npz: mobile_position (S, 2), station_position (T, 2) [m, east and north], rssi_db (S,
T) [dB], station (T,) names, latitude, longitude (S,) [deg], frequency_hz () [Hz].
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError, Problems, shorten
from gsparc.base.files import read_text
from gsparc.base.limits import choice, finite_array, number
from gsparc.data.georeference import find_invalid_coordinate
from gsparc.datasets.campaign import Campaign, read_converted
from gsparc.tables.raw import Raw

CARRIER_HZ = 462.7e6
NO_VALUE_DB = -101.0
# Above ground: a radio in a hand; a wall or mast, which the release does not say.
WALKER_M, STATION_M = 1.5, 10.0
STATIONS = "location_coordinates.json"
PLACE, TIME = {"tx_latitude": "tx_x_coord", "tx_longitude": "tx_y_coord"}, "timestamp"


def read_powder(
    path: str | Path,
    station_table: str | Path | None = None,
    tx_height: float = WALKER_M,
    station_height: float = STATION_M,
    sensitivity_db: Mapping[str, float] | None = None,
) -> Raw:
    """Read an npz, or the release's CSV; NaN is no value.

    Args:
        path: *.npz or *.csv.
        station_table: coordinates of the stations of a CSV; None takes `location_coordinates.json`
            beside it.
        tx_height, station_height: above ground [m], the same for all; the ground is taken as flat.
        sensitivity_db: of some stations, by name: weaker levels are noise, nothing was heard [dB].

    Returns:
        `latitude`, `longitude` (S,), `station_latitude`, `station_longitude` (T,) [deg],
        `tx_height`, `station_height` () [m], `rssi_db` (S, T) [dB, each station on a scale of its
        own], `station_name` (T,), `carrier_hz` (); of a CSV also `row_name` (S,).
        A note says which columns are no stations.

    Raises:
        DataError: no such file, or something in it is missing or wrong; all problems with line and
            column.
    """
    path = Path(path)
    for name, height in (("tx_height", tx_height), ("station_height", station_height)):
        number(-np.inf).check(f"dataset.{name}", height)
    if path.suffix.lower() == ".csv":
        raw = _of_csv(path, Path(station_table or path.with_name(STATIONS)))
    else:
        raw = _of_npz(path)
    heights = {
        "tx_height": np.array(float(tx_height)),
        "station_height": np.array(float(station_height)),
    }
    if sensitivity_db:
        names = raw.arrays["station_name"].tolist()
        for name in sensitivity_db:
            choice(*names).check("dataset.sensitivity_db", name)
        heights["sensitivity_db"] = np.array(
            [sensitivity_db.get(name, np.nan) for name in names], float
        )
    about = {"name": "powder", **raw.attributes, "layout": "powder"}
    return replace(raw, arrays={**raw.arrays, **heights}, attributes=about)


def _of_npz(path: Path) -> Raw:
    raw = read_converted(path, "powder npz")
    places, stations = raw.arrays.pop("tx_position"), raw.arrays.pop("station_position")
    degrees = np.stack([raw.arrays["latitude"], raw.arrays["longitude"]], axis=1)
    # Rows are known in degrees and in metres: over a campus an affine map is good to centimetres.
    middle, mean = places.mean(axis=0), degrees.mean(axis=0)
    turn = np.linalg.lstsq(places - middle, degrees - mean, rcond=None)[0]
    latitude, longitude = ((stations - middle) @ turn + mean).T
    return replace(
        raw, arrays={**raw.arrays, "station_latitude": latitude, "station_longitude": longitude}
    )


def _of_csv(path: Path, table: Path) -> Raw:
    from gsparc.tables.column import Column  # here, as pandas takes half a second to import
    from gsparc.tables.opening import read_sheet
    from gsparc.tables.places import read_places

    sheet, stations = read_sheet(path), read_station_places(table)
    missing = [head for head in PLACE.values() if head not in sheet.heads]
    if missing:
        raise DataError(
            f"{path}, line 1: no column {' and '.join(missing)}; expected those of single_tx.csv"
        )

    columns = [head for head in sheet.heads if head in stations]
    if not columns:
        example = next(iter(stations), "none")
        raise DataError(f"{path}, line 1: no column is a station of {table}, e.g. {example}")
    walk = read_places(
        sheet, {role: (Column(role, head=head),) for role, head in PLACE.items()}, "tx_"
    )
    levels = [sheet.numbers(name) for name in columns]
    sheet.problems.raise_if_any()
    assert walk is not None
    rssi = np.stack([level for level in levels if level is not None], axis=1)
    rest = [head for head in sheet.heads if head not in (*columns, *PLACE.values(), TIME)]
    notes = (
        (shorten(f"{len(rest)} columns left out, no fixed place: {', '.join(rest)}"),)
        if rest
        else ()
    )
    where = np.array([stations[name] for name in columns])
    arrays = {
        "latitude": walk.across[:, 0],
        "longitude": walk.across[:, 1],
        "station_latitude": where[:, 0],
        "station_longitude": where[:, 1],
        "station_name": np.array(columns),
        "carrier_hz": np.array(CARRIER_HZ),
        "rssi_db": np.where(rssi == NO_VALUE_DB, np.nan, rssi),
        "row_name": np.array(sheet.rows),
    }
    return Raw(arrays, notes=notes)


def read_station_places(path: Path) -> dict[str, tuple[float, float]]:
    """Return latitude and longitude [deg] of the stations that stay put, by name.

    Args:
        path: a table from names to pairs in Python's notation; None stands for a station that
            drives.

    Raises:
        DataError: missing, not readable, or no pair of degrees.
    """
    expected = "the stations' coordinates, name the file with dataset.station_table"
    text = read_text(path, f"missing; expected {expected}")
    try:
        content = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        content = None
    if not isinstance(content, Mapping):
        raise DataError(
            f"{path}: not readable; expected a table from names to (latitude, longitude)"
        )
    problems, places = Problems(path), {}
    for name, value in content.items():
        degrees = finite_array(value)
        if value is not None and degrees.shape != (2,):
            problems.add(
                f"{path}, {name}", f"expected latitude and longitude [deg], found {value!r}"
            )
        elif value is not None and (fault := find_invalid_coordinate(*degrees)):
            problems.add(f"{path}, {name}", fault[1])
        elif value is not None:
            places[str(name).strip()] = (degrees[0], degrees[1])
    problems.raise_if_any()
    if not places:
        raise DataError(f"{path}: no station with coordinates in it")
    return places


class Powder(Campaign):
    """Powers of a walking transmitter at fixed stations;
    settings of `read_powder` and of `Campaign`.
    """

    choice, reader = "powder", staticmethod(read_powder)
    marks = frozenset({"mobile_position", "latitude"})

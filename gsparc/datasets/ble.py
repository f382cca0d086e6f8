"""Received powers of a Bluetooth beacon at the sensors of a hall (Position-Annotated BLE RSSI).

The release is a folder: cnf/tetam.dev says where sensors are (its first line, Dongles: and JSON),
and hst/set_N/SENSOR_X_Y_Z.mbd holds a line `time,sensor,beacon,dBm` per packet heard
from the place X, Y, Z [m].

The same as an npz, of one set: mobile_position (S, 3), station_position (T, 3) [m]; rssi_db (S, T)
[dBm], means; station (T,) names; frequency_hz () [Hz].
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError, Problems
from gsparc.base.files import read_text
from gsparc.base.limits import parse_numbers
from gsparc.datasets.campaign import Campaign, read_converted
from gsparc.tables.raw import Raw

CARRIER_HZ = 2.44e9  # the middle of the three frequencies that beacons use in turns


def read_ble(path: str | Path, hall: int = 1) -> Raw:
    """Read a folder of the release, or an npz; NaN is no value.

    Args:
        path: folder with `cnf` and `hst`, or *.npz.
        hall: number of the set, in a folder: hst/set_1 or hst/set_2.

    Returns:
        `tx_position` (S, 3), `station_position` (T, 3) [m], `rssi_db` (S, T) [dBm], `station_name`
        (T,) and `carrier_hz` ().

    Raises:
        DataError: no such file, or an array is missing, or a line is none of the release.
    """
    folder = Path(path).is_dir()
    return (
        _of_release(Path(path), hall) if folder else read_converted(path, "ble npz", layout="ble")
    )


def _of_release(root: Path, hall: int) -> Raw:
    sensors, folder = read_sensor_places(root / "cnf" / "tetam.dev"), root / "hst" / f"set_{hall}"
    problems, levels = Problems(root), dict[tuple[str, str], float]()
    for file in sorted(folder.glob("*.mbd")):
        name, _, place = file.stem.partition("_")
        if name not in sensors:
            problems.add(file, f"no sensor of cnf/tetam.dev is called {name!r}")
        elif len(parse_numbers(place.split("_"))) != 3:
            problems.add(file, "expected a name like sensor10_X_Y_Z.mbd with a place in metres")
        elif (mean := problems.attempt(lambda file=file: read_mean_level(file))) is not None:  # type: ignore[misc]
            levels[name, place] = mean
    problems.raise_if_any()
    if not levels:
        raise DataError(
            f"{folder}: no *.mbd files; expected packets of each sensor in hst/set_{hall}"
        )
    where = sorted(
        {place for _, place in levels}, key=lambda place: tuple(map(float, place.split("_")))
    )
    rssi = [[levels.get((name, place), np.nan) for name in sensors] for place in where]
    arrays = {
        "tx_position": np.array([place.split("_") for place in where], np.float64),
        "station_position": np.array(list(sensors.values())),
        "station_name": np.array(list(sensors)),
        "rssi_db": np.array(rssi, np.float32),
        "carrier_hz": np.array(CARRIER_HZ),
    }
    return Raw(arrays, {"layout": "ble"})


def read_sensor_places(path: Path) -> dict[str, np.ndarray]:
    """Return places (3,) [m] of the sensors by name, out of `tetam.dev`;
    DataError where it is another.
    """
    expected = 'expected a first line Dongles:{"ADDRESS": [[x, y, z], COLOUR, "NAME"], ...}'
    head = read_text(path, f"missing; {expected}").partition("\n")[0]
    try:
        if not head.startswith("Dongles:"):
            raise ValueError
        listed = json.loads(head.removeprefix("Dongles:"))
        return {
            str(name): np.array(place, np.float64).reshape(3) for place, _, name in listed.values()
        }
    except (ValueError, TypeError, AttributeError, RecursionError):
        raise DataError(f"{path}, line 1: {expected}") from None


def read_mean_level(path: Path) -> float:
    """Return the mean level [dBm] of the packets of one sensor at one place.

    DataError where a line is no packet.
    """
    lines = read_text(path, "missing").splitlines()
    levels = parse_numbers([line.rpartition(",")[2] for line in lines])
    if not lines or len(levels) != len(lines) or any(line.count(",") != 3 for line in lines):
        raise DataError(f"{path}: expected lines of time, sensor, beacon and dBm")
    return float(levels.mean())


class BLE(Campaign):
    """Powers of a beacon at many places, at the sensors of a hall; settings of `read_ble`,
    `Campaign`.
    """

    choice, reader = "ble", staticmethod(read_ble)
    inside, marks = "cnf/tetam.dev", frozenset({"mobile_position", "rssi_db"})

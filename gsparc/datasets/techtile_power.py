"""Received power on a plane under Techtile's ceiling (KU Leuven, geometry-based wireless power
transfer).

The release is a folder of a run, with TIME_positions.npy and TIME_values.npy: arrays of Python
objects, positions with x, y, z [m], values with pwr_pw [pW]. The 42 antennas transmit one tone,
with unknown weights.

The same as an npz: rx_position (S, 3) [m], rssi_db (S,) [dBm], frequency_hz () [Hz].
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError, readable
from gsparc.base.pickles import read_pickle
from gsparc.datasets.campaign import Campaign
from gsparc.physics.decibels import to_decibels
from gsparc.tables.raw import Raw, read_raw

CARRIER_HZ = 920e6
PICOWATT_DB = -90.0  # relative to a milliwatt
# Classes of the makers' recorder
POSITIONS, VALUES = {"Positioner.PositionerValue"}, {"lib.ep.ep_data"}


def read_techtile_power(path: str | Path) -> Raw:
    """Read a folder of a run of the release, or an npz.

    Returns:
        `rx_position` (S, 3) [m], `rssi_db` (S,) [dBm], `frequency_hz` () [Hz].

    Raises:
        DataError: no such file, or objects of other classes.
    """
    raw = _of_release(Path(path)) if Path(path).is_dir() else read_raw(path)
    return replace(raw, attributes={"name": "techtile_power", **raw.attributes})


def _of_release(folder: Path) -> Raw:
    places = sorted(folder.glob("*_positions.npy"))
    if len(places) != 1:
        raise DataError(
            f"{folder}: expected one *_positions.npy with its *_values.npy, found {len(places)}"
        )
    file = places[0].with_name(places[0].name.replace("_positions", "_values"))
    where = _attributes(places[0], POSITIONS, ("x", "y", "z"))
    power = _attributes(file, VALUES, ("pwr_pw",))[:, 0]
    if len(where) != len(power):
        raise DataError(f"{folder}: {len(where)} positions, but {len(power)} values")
    with np.errstate(divide="ignore", invalid="ignore"):
        level = to_decibels(power) + PICOWATT_DB
    heard = np.isfinite(where).all(axis=1) & np.isfinite(level)
    arrays = {
        "rx_position": where[heard].astype(np.float32),
        "rssi_db": level[heard].astype(np.float32),
        "frequency_hz": np.array(CARRIER_HZ),
    }
    note = f"{(~heard).sum()} of {len(heard)} rows left out: no position, or no power"
    return Raw(arrays, notes=() if heard.all() else (note,))


def _attributes(path: Path, classes: set[str], names: tuple[str, ...]) -> np.ndarray:
    """Attributes (rows, names) of the objects in an array; DataError where one has none of them."""
    objects: Any = read_pickle(path, classes, npy=True)
    errors = (AttributeError, KeyError, TypeError, ValueError)
    with readable(path, f"expected an array of objects with {', '.join(names)}", errors):
        return np.array([[float(entry.state[name]) for name in names] for entry in objects])


class TechtilePower(Campaign):
    """Received powers on a plane; settings of `Campaign`."""

    choice, reader = "techtile_power", staticmethod(read_techtile_power)
    inside = "*_positions.npy"

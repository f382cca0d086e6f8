"""Channels of a moving transmitter at the ceiling antennas
of Techtile (KU Leuven, ELLIIIT-dataset-26).

The release is a NetCDF file of experiments E, cycles C (stops of the robot) and hosts H (one
antenna each): csi_real, csi_imag (E, C, H); rover_x, rover_y, rover_z (E, C) [m]; experiment_id
(E,), cycle_id (C,), hostname (H,); optional csi_available (E, C, H), position_available (E, C). A
file of one experiment may lack its axis. The antennas are in a file of their own,
`techtile_antenna_locations.yml` of techtile-description.

The same as an npz: tx_position (S, 3), rx_antenna_position (T, 3) [m], csi (S, T), mask (S, T), run
(S,), frequency_hz ().
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import DataError
from gsparc.base.files import read_yaml
from gsparc.base.limits import finite_array
from gsparc.datasets.campaign import Campaign, check_layout, read_converted, read_layout
from gsparc.tables.raw import NETCDF_SUFFIXES, Raw, read_raw

CARRIER_HZ = 920e6  # the tone; files of the release do not name it
CHANNEL = 1  # of the two antennas of a tile, the one that received
ANTENNAS = "techtile_antenna_locations.yml"


def read_techtile(path: str | Path, antennas: str | Path | None = None) -> Raw:
    """Read an npz, or a NetCDF file of the release.

    Args:
        path: *.npz, or *.nc (also *.nc4, *.cdf).
        antennas: YAML file with the antennas' places, for NetCDF files without
            `rx_antenna_position`; None takes `techtile_antenna_locations.yml` beside `path`.

    Returns:
        `tx_position` (S, 3), `station_position` (T, 3) [m], `csi` (S, T) complex that follows
        `exp(-j 2 pi f d / c)`, `mask` (S, T), `run` (S,), `frequency_hz` (); of a NetCDF file also
        `station_name` (T,) and `row_name` (S,). A note says which cycles are no rows.

    Raises:
        DataError: no such file, or variables missing or wrong; all problems with array and row.
    """
    path = Path(path)
    if path.suffix.lower() in NETCDF_SUFFIXES:
        return _of_release(_with_experiments(read_raw(path), path), path, antennas)
    return read_converted(path, "techtile npz", name="techtile", layout="techtile")


def _with_experiments(raw: Raw, path: Path) -> Raw:
    """The same with an axis of experiments where a file of one experiment has none."""
    if "csi_real" not in raw.arrays or raw.arrays["csi_real"].ndim != 2:
        return raw
    arrays = dict(raw.arrays)
    for field in read_layout("techtile"):
        if field.shapes[0][0] == "E" and field.name in arrays and field.name != "experiment_id":
            arrays[field.name] = arrays[field.name][None]
    arrays["experiment_id"] = np.atleast_1d(arrays.get("experiment_id", np.array(path.stem)))
    return Raw(arrays, raw.attributes, raw.units)


def _of_release(raw: Raw, path: Path, antennas: str | Path | None) -> Raw:
    variables = check_layout(raw, path, "techtile", places=["rx_antenna_position"])
    hosts = variables["hostname"].astype(str)
    places = variables.get("rx_antenna_position")
    if places is None:
        places = read_antenna_positions(Path(antennas or path.with_name(ANTENNAS)), hosts)
    # Stored is reference minus received phase: the conjugate of a channel that follows exp(-j k d).
    csi = variables["csi_real"].astype(np.float64) - 1j * variables["csi_imag"].astype(np.float64)
    heard = np.isfinite(csi) & (variables.get("csi_available", np.ones(csi.shape)) == 1)
    where = np.stack([variables[f"rover_{axis}"] for axis in "xyz"], axis=-1).astype(np.float64)
    placed = np.isfinite(where).all(-1) & (
        variables.get("position_available", np.ones(where.shape[:2])) == 1
    )
    measured = heard.any(-1)
    experiment, cycle = np.nonzero(measured & placed)
    if not len(experiment):
        raise DataError(f"{path}: no cycle has both a position and a channel; is it another file?")
    run = variables["experiment_id"].astype(str)[experiment]
    number = variables["cycle_id"].astype(str)[cycle]
    drop_count = int((measured & ~placed).sum())
    notes = (
        (f"{drop_count} of {int(measured.sum())} cycles left out: no position",)
        if drop_count
        else ()
    )
    arrays = {
        "tx_position": where[experiment, cycle],
        "station_position": np.asarray(places, dtype=np.float64),
        "station_name": hosts,
        "csi": np.where(heard, csi, 0)[experiment, cycle],
        "mask": heard[experiment, cycle],
        "run": run,
        "frequency_hz": np.array(CARRIER_HZ),
        "row_name": np.array([f"{r} cycle {n}" for r, n in zip(run, number, strict=True)]),
    }
    return Raw(arrays, {"name": "techtile", "layout": "techtile"}, notes=notes)


def read_antenna_positions(path: Path, hosts: np.ndarray) -> np.ndarray:
    """Return places (T, 3) float64 [m] of the receiving antennas of `hosts` (T,)
    from Techtile's table.

    Args:
        path: YAML with `antennes:`, a list of `tile` and its two `channels` with `x`, `y`, `z` [m].
        hosts: names of tiles.

    Raises:
        DataError: missing, of another form, or without one of the hosts.
    """
    expected = "`antennes:` with a list of tile, channels: [{x, y, z}, {x, y, z}] [m]"
    absent = f"the antennas' places; name the file with dataset.antennas, {expected}"
    content = read_yaml(path, absent, expected)
    entries = content.get("antennes", content.get("antennas"))
    if not isinstance(entries, list):
        raise DataError(f"{path}: expected {expected}")
    table = {
        str(entry.get("tile")).upper(): entry for entry in entries if isinstance(entry, Mapping)
    }
    missing = [str(host) for host in hosts if str(host).upper() not in table]
    if missing:
        raise DataError(
            f"{path}: no antenna of the tiles {', '.join(missing)}; expected one of each host"
        )
    return np.array([_channel(path, str(host), table[str(host).upper()]) for host in hosts])


def _channel(path: Path, host: str, entry: Mapping[str, Any]) -> np.ndarray:
    channels: Any = entry.get("channels")
    try:
        # Of a list, or of a table with numbers.
        place = finite_array([channels[CHANNEL][axis] for axis in "xyz"])
    except (TypeError, KeyError, IndexError):
        place = np.zeros(0)
    if not len(place):
        raise DataError(
            f"{path}, {host}: expected x, y, z [m] of channel {CHANNEL}, found {channels!r:.80}"
        )
    return place


class Techtile(Campaign):
    """Channels of a moving transmitter at 42 antennas;
    settings of `read_techtile` and of `Campaign`.
    """

    choice, reader = "techtile", staticmethod(read_techtile)
    marks, suffixes = frozenset({"rx_antenna_position", "csi"}), NETCDF_SUFFIXES

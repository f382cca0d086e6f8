"""Measurements of one's own, `dataset=own`, and whatever file or folder `gsparc check` is given."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsparc.data.conventions import CONVENTIONS
from gsparc.data.datasets.ble import raw_of_ble
from gsparc.data.datasets.campaign import Campaign
from gsparc.data.datasets.newrf import SUFFIXES, raw_of_newrf
from gsparc.data.datasets.powder import raw_of_powder
from gsparc.data.datasets.rfid import load_rfid
from gsparc.data.datasets.techtile import raw_of_techtile
from gsparc.data.datasets.techtile_power import raw_of_techtile_power
from gsparc.data.datasets.wifi_csi import raw_of_wifi_csi
from gsparc.data.datasets.wsr import raw_of_wsr
from gsparc.data.errors import Caution, DataError
from gsparc.data.limits import choice, or_null, switch
from gsparc.data.own import Reading, interpret
from gsparc.data.raw import NETCDF_SUFFIXES, Noted, Raw, read_raw
from gsparc.data.tables import is_table

log = logging.getLogger(__name__)


def raw_of_own(
    path: str | Path,
    columns: Mapping[str, object] | None = None,
    stations_file: str | Path | None = None,
    cell_m: float | None = None,
    not_heard: Sequence[float] | None = None,
    absent: str = "auto",
    **conventions: bool | None,
) -> Raw:
    """Read a file of docs/reference/schema.md, or a table under the schema's names; notes are logged.

    Args:
        path: *.npz, *.h5 or *.hdf5, or a table: *.csv, *.tsv, *.txt or *.parquet.
        columns: of a table, by quantity, where the guess from their heads will not do.
        stations_file: of a table, a second one that lists the stations.
        cell_m: of Parquet, also a folder or a URL of it: means of rows [dB] by cells of this side [m].
        not_heard: levels that mean that nothing was heard; None: those that stand apart from all others.
        absent: `silent`: a station without a row at a place where others have one was not heard there;
            `auto`: one that a list of the strongest leaves out is below its weakest; `unknown`: neither.
        **conventions: those of `CONVENTIONS` that the file follows instead of the schema's.

    Raises:
        DataError: bad input, or a file of another campaign.
        SettingError: another word for `absent`.
    """
    raw, notes = raw_of(path, columns, stations_file, cell_m)
    raw = understood(raw, not_heard, absent, **conventions)
    campaign = campaign_of(raw)
    if campaign is not None:
        raise DataError(f"{path}: this is a file of dataset={campaign}; say dataset={campaign}")
    for note in notes:
        log.log(logging.WARNING if isinstance(note, Caution) else logging.INFO, "%s: %s", path, note)
    return raw


def understood(
    raw: Raw,
    not_heard: Sequence[float] | None = None,
    absent: str = "auto",
    **conventions: bool | None,
) -> Raw:
    """The same with what settings say of the file; see `raw_of_own`."""
    choice("auto", "unknown", "silent").check("dataset.absent", absent)
    said: dict[str, Any] = {} if not_heard is None else {"not_heard": [float(mark) for mark in not_heard]}
    said |= {} if absent == "auto" else {"absent": absent}
    for name, follows in conventions.items():
        or_null(switch()).check(f"dataset.{name}", follows)
    followed = [name for name, follows in conventions.items() if follows]
    said |= {"conventions": " ".join(followed)} if followed else {}
    return replace(raw, attributes={**raw.attributes, **said})


class Own(Campaign):
    """Measurements of one's own; suspicious units are warned of. Settings of `raw_of_own` and `Campaign`."""

    choice, reader, switches = "own", staticmethod(raw_of_own), tuple(CONVENTIONS)


LOADERS: dict[str, Callable[[Path], Raw]] = {
    "techtile": raw_of_techtile,
    "powder": raw_of_powder,
    "ble": raw_of_ble,
    "newrf": raw_of_newrf,
    "techtile_power": raw_of_techtile_power,
    "wsr": raw_of_wsr,
    "wifi_csi": raw_of_wifi_csi,
}
# What lies in folders of releases.
FOLDERS = {
    "ble": "cnf/tetam.dev", "techtile_power": "*_positions.npy",
    "wsr": "**/csi_rx_*.dat", "wifi_csi": "*.pcap",
}  # fmt: skip
PLANE = 2  # coordinates of places in POWDER's files


def campaign_of(raw: Raw) -> str | None:
    """The choice of conf/dataset that reads a file with these arrays; None where it is of none of them."""
    arrays = raw.arrays
    if {"rx_antenna_position", "csi"} <= set(arrays):
        return "techtile"
    if {"mobile_position", "rssi_db"} <= set(arrays):
        flat = arrays["mobile_position"].ndim == 2 and arrays["mobile_position"].shape[1] == PLANE
        return "powder" if flat else "ble"
    if {"h2", "root_sign"} <= set(arrays):
        return "wsr"
    return "newrf" if {"tx_pos", "rx_pos"} <= set(arrays) else None


def release_of(path: Path) -> str | None:
    """The choice of conf/dataset that reads a file or folder of its makers' release; None where none does."""
    if path.suffix.lower() in NETCDF_SUFFIXES:
        return "techtile"
    if path.suffix.lower() in SUFFIXES:
        return "newrf"
    return next((name for name, inside in FOLDERS.items() if path.is_dir() and any(path.glob(inside))), None)


def read_any(
    path: str | Path,
    columns: Mapping[str, object] | None = None,
    stations_file: str | Path | None = None,
    **settings: Any,
) -> Reading:
    """Read a folder or file of a release, a file of another campaign, one of one's own, or a table.

    Args:
        path: folder or file.
        columns, stations_file: of a table, see `raw_of_own`.
        **settings: see `understood`.

    Raises:
        DataError: it is none of them, or something in it is wrong.
    """
    path = Path(path)
    release = release_of(path)
    if release is not None:
        reading = interpret(LOADERS[release](path), path)
        return Reading(reading.data, (f"this is the release of dataset={release}", *reading.notes))
    if path.is_dir():
        if not any((path / name).exists() for name in ("gateway_info.yml", "tx_pos.csv", "spectrum")):
            raise DataError(
                f"{path}: a folder without gateway_info.yml, tx_pos.csv and spectrum/ (the RFID release's "
                "layout); for measurements of your own give the npz or HDF5 file"
            )
        return Reading(load_rfid(path), ())
    raw, notes = raw_of(path, columns, stations_file)
    campaign = campaign_of(raw)
    if campaign is not None:
        raw, notes = LOADERS[campaign](path), (f"this is a file of dataset={campaign}",)
    reading = interpret(understood(raw, **settings), path)
    return Reading(reading.data, (*notes, *reading.notes))


def raw_of(
    path: str | Path,
    columns: Mapping[str, object] | None = None,
    stations_file: str | Path | None = None,
    cell_m: float | None = None,
) -> Noted:
    """The arrays of a file of the schema, or of a table, and how its columns were understood.

    Raises:
        DataError: not readable, or columns that nothing can be made of.
    """
    if cell_m is None and not is_table(path):
        named = any(value is not None for value in (columns or {}).values())
        for name in [name for name, given in (("columns", named), ("stations_file", stations_file)) if given]:
            raise DataError(f"dataset.{name}: goes with tables (*.csv, *.parquet), not with {path}")
        return Noted(read_raw(path))
    from gsparc.data.tables.read import understand_table  # here, as pandas takes half a second to import

    return understand_table(path, columns or {}, stations_file, cell_m)

"""From files with stations, missing or censored values,
or an unknown transmitter to one row per link.

A file may hold one row per place and a column per station (wide), or one row per link that names
its station (long). In memory every row is a link: tx, rx, what was measured between them,
and which station it is of.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.data.schema import MEASUREMENTS, OTHER, Links, Stations
from gsparc.data.selection import Selection, select, take_rows
from gsparc.data.spacing import number_places
from gsparc.tables.links.absent import add_absent, add_unlisted
from gsparc.tables.links.hearing import POWERS, censor_rows, check_said, forget_unknown
from gsparc.tables.links.positions import positions_in_metres
from gsparc.tables.links.stations import (
    SECTOR,
    find_static_end,
    read_station_of_row,
    read_station_table,
    split_by_carrier,
)
from gsparc.tables.own_checks import Checker
from gsparc.tables.raw import Raw, numbered_rows

_OF_STATIONS = ("position", "name", "label", "orientation")
STATION_FIELDS = ("station", *(f"station_{name}" for name in _OF_STATIONS), *SECTOR)


def expand_links(check: Checker, measured: str, part: Selection) -> Links | None:
    """Replace `check.raw` by rows of links, stations, places and runs as numbers; None:
    something is wrong.

    Args:
        check: of the file; notes say what was left out.
        measured: name of the measurement.
        part: of the campaign.
    """
    check_said(check.raw.attributes)
    check.raw = replace(check.raw, arrays=dict(check.raw.arrays))
    # Numbers of the file: rows are repeated and left out below
    rows = len(check.raw.arrays[measured])
    check.raw.arrays.setdefault("row_name", numbered_rows(rows))
    check.raw.arrays["file_row"] = np.arange(rows)
    well, origin = positions_in_metres(check, measured)
    if not well:
        return None
    read = _with_table if "station_position" in check.raw.arrays else _without_table
    links = read(check, measured, part)
    if links is None:
        return None
    arrays = check.raw.arrays
    if links.stations is not None:
        # From here on rows have positions of their own, as in a file of one static end.
        arrays[f"{links.static_end}_position"] = links.stations.position[arrays["station"]]
        if links.stations.rotation is not None:
            arrays["rx_rotation"] = links.stations.rotation[arrays["station"]]
    return replace(links, georeference=origin)


def _selected(
    check: Checker, measured: str, stations: Stations | None, part: Selection
) -> Stations | None:
    """Leave out what `part` does not hold, and number runs and places anew;
    the stations that are left.
    """
    arrays, stations, notes = select(check.raw.arrays, measured, stations, part, check.source)
    check.raw, check.notes = replace(check.raw, arrays=arrays), [*check.notes, *notes]
    runs = check.read_array("run", arrays[measured].shape[:1])
    arrays |= {} if runs is None else {"run": np.unique(runs, return_inverse=True)[1].reshape(-1)}
    arrays |= {} if "place" not in arrays else {"place": number_places(arrays["place"])}
    return stations


def _without_table(check: Checker, measured: str, part: Selection) -> Links | None:
    """A file of one static end, of an end at few places, of two ends that move,
    or of powers from nowhere.
    """
    for name in check.present(*STATION_FIELDS):
        return check.refuse(
            name, "given without station_position; expected the stations' places, (T, 3)"
        )
    _selected(check, measured, None, part)
    arrays = check.raw.arrays
    rows = len(arrays[measured])
    # Powers alone can be learned without the transmitter's place:
    # channels and spectra need both ends.
    if measured in POWERS and not check.present("tx_position") and "rx_position" in arrays:
        check.notes.append("no tx_position: the transmitter's place is unknown")
        arrays["tx_position"] = np.full(3, np.nan)
        links, moving = Links("tx", unknown_transmitter=True), arrays["rx_position"]
    else:
        ends = [check.read_real(f"{end}_position", (3,), (rows, 3)) for end in ("rx", "tx")]
        if any(end is None for end in ends):
            return Links("tx")  # what is missing is said where positions are read
        rx, tx = (np.broadcast_to(np.asarray(end), (rows, 3)) for end in ends)
        links, moving = find_static_end(check, rx, tx), np.hstack([rx, tx])
        carrier = check.read_real("carrier_hz", (), (rows,))
        # Rows at several carriers: a station at each.
        if carrier is not None and carrier.ndim and links.static_end is not None:
            still, other = (rx, tx) if links.static_end == "rx" else (tx, rx)
            arrays.setdefault("station", np.zeros(rows, np.int64))
            arrays["place"] = number_places(other)
            stations = links.stations or Stations(still[:1].astype(np.float64), (links.static_end,))
            links = replace(links, stations=split_by_carrier(check, stations, measured in POWERS))
            links = links if len(links.stations or ()) > 1 else replace(links, stations=None)
    if links.stations is None and moving.ndim == 2 and len(moving) == rows:
        place = number_places(moving)
        if len(np.unique(place)) < rows:  # a place visited twice is not learned from and tested on
            arrays["place"] = place
    return censor_rows(check, measured, links)


def _with_table(check: Checker, measured: str, part: Selection) -> Links | None:
    """A file with a table of stations, wide or long, as one row per link."""
    before = len(check.problems)
    stations = read_station_table(check, measured in (*POWERS, "csi"))
    ends = check.present("rx_position", "tx_position")
    if len(ends) != 1:
        names = " and ".join(ends) or "neither"
        wanted = "expected rx_position or tx_position, of the end that moves"
        return check.refuse("station_position", f"{wanted}; found {names}")
    if stations is None:
        return None
    arrays, count, static = check.raw.arrays, len(stations), OTHER[ends[0][:2]]
    values = arrays[measured]
    if count == 1 and values.shape[1:2] != (1,):  # one station has no columns to tell apart
        arrays.setdefault("station", np.zeros(len(values), np.int64))
    rows, long = len(values), "station" in arrays
    if not long and (values.ndim < 2 or values.shape[1] != count):
        return check.refuse(
            measured,
            f"expected shape (S, {count}, ...), a column for each station, found "
            f"{values.shape}; "
            "or say which station each row is of with `station` (S,)",
        )
    station = read_station_of_row(check, rows, count) if long else np.tile(np.arange(count), rows)
    row = np.repeat(np.arange(rows), 1 if long else count)
    stated = {
        name: check.read_real(name, (), (count,), (rows,))
        for name in ("carrier_hz", "sensitivity_db")
    }
    positions = check.read_real(ends[0], (rows, 3))
    if static == "tx" and stations.rotation is not None:
        check.refuse("station_orientation", "transmitting stations are not turned; leave it out")
    if len(check.problems) > before or station is None or positions is None:
        return None
    arrays["place"] = number_places(positions)
    if not long:  # a wide row becomes as many rows as there are stations, side by side
        check.raw = _unrolled(check.raw, measured, count)
    check.raw.arrays["station"] = station
    for name, value in stated.items():
        # Of as many rows as stations, carriers are taken as of rows
        if value is not None and value.ndim:
            by_row = len(value) == rows and (rows != count or name == "carrier_hz")
            check.raw.arrays[name] = value[row if by_row else station]
            if by_row and rows == count and len(np.unique(value)) > 1:
                remark = "as many values as rows and as stations; taken as one for each row"
                check.notes.append(f"{name}: {remark}")
    for name in STATION_FIELDS[1:]:
        check.raw.arrays.pop(name, None)
    stations = _selected(check, measured, stations, part) or stations
    stations = split_by_carrier(check, stations, measured in POWERS)
    if measured == "rssi_db":
        forget_unknown(check, ends[0])  # before lists are looked for, in which they would be strong
    absent = check.raw.attributes.get("absent", "auto")
    levels, listened = measured == "rssi_db", not long
    unlisted = add_unlisted(check, stations, static, absent, listened) if levels else 0
    if absent == "silent":
        add_absent(check, measured, len(stations))
    return censor_rows(check, measured, Links(static, stations), unlisted)


def _unrolled(raw: Raw, measured: str, count: int) -> Raw:
    """Rows of a wide file, one for each station."""
    rows = len(raw.arrays[measured])
    wide = {name: raw.arrays[name] for name in (measured, "mask") if name in raw.arrays}
    for name, array in wide.items():
        if array.shape[:2] == (rows, count):
            wide[name] = array.reshape(rows * count, *array.shape[2:])
    other = {
        name: array for name, array in raw.arrays.items() if name not in (*MEASUREMENTS, "mask")
    }
    return replace(raw, arrays=take_rows(other, np.repeat(np.arange(rows), count), rows) | wide)

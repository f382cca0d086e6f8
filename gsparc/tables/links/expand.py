"""From files with stations, missing or censored values,
or an unknown transmitter to one row per link.

A file may hold one row per place and a column per station (wide), or one row per link that names
its station (long). In memory every row is a link: tx, rx, what was measured between them,
and which station it is of.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.base.errors import Question, Severe, list_first
from gsparc.data.assemble import FARTHEST
from gsparc.data.schema import OTHER, End, StaticEnds, Stations
from gsparc.data.selection import Selection, select, take_rows
from gsparc.data.spacing import number_places
from gsparc.data.target import MEASUREMENTS
from gsparc.tables.arrays import Raw, name_rows_by_number
from gsparc.tables.checks.piles import find_sentinel_levels
from gsparc.tables.links.hearing import POWERS, blank_ambiguous_marks, censor_rows, check_said
from gsparc.tables.links.positions import convert_positions
from gsparc.tables.links.stations import (
    SECTOR,
    find_static_end,
    read_station_of_row,
    read_station_table,
    split_by_carrier,
)
from gsparc.tables.links.strongest import StrongestLists
from gsparc.tables.own_checks import Checker

LEAST_LISTED = 3  # stations, for a floor
UNLISTED_EACH = 2  # rows of what is not listed for one that is


def add_silent_links(check: Checker, measured: str, count: int) -> None:
    """Say that each of `count` stations without a level at a place
    where others have one was not heard.
    """
    if measured != "rssi_db":
        return check.problems.add("dataset.absent", f"goes with levels [dB], not with {measured}")
    arrays = check.raw.arrays
    if arrays["rssi_db"].ndim != 1:
        return None  # refused where values are read
    _, first, of_place = np.unique(arrays["place"], return_index=True, return_inverse=True)
    of_place = of_place.reshape(-1)
    has_level = ~np.isnan(arrays["rssi_db"])
    some = np.bincount(of_place, has_level) > 0
    # Links are numbered place by station, so that those without a row are a set difference.
    gaps = np.setdiff1d(np.arange(len(first) * count), of_place * count + arrays["station"])
    gaps = gaps[some[gaps // count]]
    floor = _floors(arrays, count)
    # Minus infinity lies below whatever turns out to be the limit of hearing.
    _repeat(check, np.r_[: len(of_place), first[gaps // count]], gaps % count)
    if floor is not None and floor.ndim:
        check.raw.arrays["sensitivity_db"][len(of_place) :] = floor[gaps % count]
    empty = np.flatnonzero(~has_level & some[of_place])  # cells of a wide table
    check.raw.arrays["rssi_db"][empty] = -np.inf
    silent = len(gaps) + len(empty)
    check.notes.append(
        f"{silent} links without a level were not heard, as dataset.absent=silent says"
    )


def add_unlisted(
    check: Checker, stations: Stations, static: End, absent: str, listened: bool
) -> int:
    """Add rows, twice as many as are heard, of what lists of the strongest or a floor leave out.

    Of pairs that no row names nobody knows whether a receiver `listened`: that is asked.

    Returns how many lists leave out. Where `absent` is not `auto` what it does
    to figures is said alone.
    """
    arrays, count = check.raw.arrays, len(stations)
    levels, of, floor = arrays["rssi_db"], arrays["station"], _floors(arrays, count)
    whole = levels.ndim == 1 and "mask" not in arrays
    heard = np.flatnonzero(np.isfinite(levels) if whole else np.zeros(0))
    if not len(heard) or ("sensitivity_db" in arrays and floor is None):
        return 0
    # Noise below a stated level has its place in a list,
    # and bounds what is not listed by that level.
    levels = np.where(
        np.isfinite(levels), np.fmax(levels, arrays.get("sensitivity_db", -np.inf)), levels
    )
    moving = arrays[f"{OTHER[static]}_position"][heard].astype(np.float64)
    moving = np.where(np.abs(moving) > FARTHEST, np.nan, moving)  # refused where positions are read
    lists = StrongestLists.from_rows(
        arrays["place"][heard], of[heard], levels[heard], moving, count
    )
    strongest = lists.are_strongest()
    # What is known not to be heard, of marks or a stated sensitivity, needs no guess.
    limit_known = (
        floor is not None or np.isneginf(levels).any() or bool(find_sentinel_levels(levels[heard]))
    )
    no_floor = strongest or limit_known or absent == "silent" or count < LEAST_LISTED
    bound = None if no_floor else lists.below_floor()
    if not strongest and bound is None:
        return 0
    listed = "the strongest alone" if lists.length == 1 else f"the {lists.length} strongest"
    missing = f"lists of {listed} of {count} stations"
    if bound is not None:
        missing = "levels are missing beside weak ones alone"
    if bound is not None and absent == "auto" and not listened:
        how = "not heard, or not measured? say dataset.absent=weaker (below each station's "
        how += "weakest), or dataset.absent=unknown (not measured, and not used)"
        check.notes.append(Question(f"{missing}: {how}"))
    if bound is not None:
        (floor, may), lists = bound, replace(lists, length=0)
        how = (
            f"not heard, below each station's weakest ({np.nanmin(floor):.4g} to "
            f"{np.nanmax(floor):.4g} dB)"
        )
        out = np.isnan(lists.level).any(0) & ~np.isnan(floor) & ~may.any(0)
        if out.any():
            how += (
                f", but of {list_first(np.array(stations.shown)[out])} unknown, strong ones "
                "are lost"
            )
    else:
        # Without a stated sensitivity, the weakest level heard anywhere bounds what lists leave
        # out.
        stated = np.full(count, np.nan if floor is None else floor)
        floor = np.nan_to_num(stated, nan=levels[heard].min())
        is_lossy = lists.short_are_lost(floor)
        may = np.isnan(lists.level) & (lists.full[:, None] | (not is_lossy))
        how = "a station that a full list leaves out is learned as below its weakest level"
        how += f", in lists shorter than {lists.length}: "
        how += "unknown, strong ones are lost there" if is_lossy else f"below {floor.min():.4g} dB"
    if absent not in ("auto", "weaker"):
        text = f"{missing} with dataset.absent={absent}: unlisted ones are predicted too "
        text += "high, or too low (silent), and figures of listed rows do not show it"
        check.notes.append(Severe(f"{text}; leave absent out"))
        return 0
    most, all_below = UNLISTED_EACH * len(heard), int(may.sum())
    of_list, station, below = lists.bound_unlisted(floor, most, may)
    _repeat(check, np.r_[heard, heard[lists.first[of_list]]], station)
    check.raw.arrays["sensitivity_db"] = np.r_[levels[heard], below]
    used = (
        "all" if len(below) == all_below else f"{len(below)} (mostly near where they are listed) of"
    )
    used = f"{used} {all_below} unlisted levels are used beside {len(heard)} listed ones"
    check.notes += [f"{missing}: {how}", f"{used} (dataset.absent=unknown uses none)"]
    return len(below) * strongest


def _floors(arrays: dict[str, np.ndarray], count: int) -> np.ndarray | None:
    """The sensitivity (), or (T,) of `count` stations where their rows agree; None elsewhere,
    or without.
    """
    floor = arrays.get("sensitivity_db")
    if floor is None or floor.ndim == 0:
        return floor
    each = np.full(count, floor.min())
    each[arrays["station"]] = floor
    return each if np.array_equal(each[arrays["station"]], floor, equal_nan=True) else None


def _repeat(check: Checker, like: np.ndarray, station: np.ndarray) -> None:
    """Take rows `like` (n,); the last of them are of stations (m,) that were not heard there."""
    arrays = take_rows(check.raw.arrays, like, len(check.raw.arrays["station"]))
    heard = len(like) - len(station)
    arrays["station"] = np.r_[arrays["station"][:heard], station]
    arrays["rssi_db"] = np.r_[
        arrays["rssi_db"][:heard].astype(np.float64), np.full(len(station), -np.inf)
    ]
    check.raw = replace(check.raw, arrays=arrays)


_OF_STATIONS = ("position", "name", "label", "orientation")
STATION_FIELDS = ("station", *(f"station_{name}" for name in _OF_STATIONS), *SECTOR)


def expand_links(check: Checker, measured: str, part: Selection) -> StaticEnds | None:
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
    check.raw.arrays.setdefault("row_name", name_rows_by_number(rows))
    check.raw.arrays["file_row"] = np.arange(rows)
    well, origin = convert_positions(check, measured)
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


def _without_table(check: Checker, measured: str, part: Selection) -> StaticEnds | None:
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
        links, moving = StaticEnds("tx", unknown_transmitter=True), arrays["rx_position"]
    else:
        ends = [check.read_real(f"{end}_position", (3,), (rows, 3)) for end in ("rx", "tx")]
        if any(end is None for end in ends):
            return StaticEnds("tx")  # what is missing is said where positions are read
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


def _with_table(check: Checker, measured: str, part: Selection) -> StaticEnds | None:
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
        blank_ambiguous_marks(
            check, ends[0]
        )  # before lists are looked for, in which they would be strong
    absent = check.raw.attributes.get("absent", "auto")
    levels, listened = measured == "rssi_db", not long
    unlisted = add_unlisted(check, stations, static, absent, listened) if levels else 0
    if absent == "silent":
        add_silent_links(check, measured, len(stations))
    return censor_rows(check, measured, StaticEnds(static, stations), unlisted)


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

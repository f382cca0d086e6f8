"""From files with stations, missing or censored values, or an unknown transmitter to one row per link.

A file may hold one row per place and a column per station (wide), or one row per link that names its station
(long). In memory every row is a link: tx, rx, what was measured between them, and which station it is of.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gsparc.data.blocks import is_big
from gsparc.data.checks.plausibility import degree_warnings, not_heard, saturation
from gsparc.data.errors import Caution, lines_of, some
from gsparc.data.limits import number, or_word
from gsparc.data.links.georeference import Georeference, bad_degrees
from gsparc.data.links.stations import SECTOR, by_carrier, ends_of, numbered, station_of_row, station_table
from gsparc.data.links.strongest import Lists, moments
from gsparc.data.own_checks import Checker
from gsparc.data.raw import Raw, numbered_rows
from gsparc.data.schema import MEASUREMENTS, OTHER, End, Links, Stations
from gsparc.data.selection import Selection, select, take_rows

POWERS = ("rssi", "rssi_db")
NOT_HEARD = "powers were not heard: below sensitivity_db"
NO_FIX_DEG, NO_FIX_M = 1.0, 1e4  # from 0, 0 to the median of all other rows, at least
FAR_BELOW_DB = 20.0  # the weakest power heard: a receiver that could hear less would have somewhere
LEAST_LISTED = 3  # stations, for lists of the strongest
SATURATION = or_word(or_word(number(-400, 400), "auto"), "none")  # [dB]
UNLISTED_EACH = 2  # rows of what is not listed for one that is
STATION_FIELDS = ("station", "station_position", "station_name", "station_orientation", *SECTOR)
OF_ROWS = ("station", "place", "run")  # arrays that go into `Links`


def expand(check: Checker, measured: str, part: Selection) -> Links | None:
    """Replace `check.raw` by one row per link of the plain schema; None where something is wrong (noted).

    Args:
        check: of the file; notes say what was left out.
        measured: name of the measurement.
        part: of the campaign.
    """
    check.raw = replace(check.raw, arrays=dict(check.raw.arrays))
    if check.raw.arrays[measured].ndim:  # numbers of the file: rows are repeated and left out below
        rows = len(check.raw.arrays[measured])
        check.raw.arrays.setdefault("row_name", numbered_rows(rows))
        check.raw.arrays["file_row"] = np.arange(rows)
    before = len(check.problems)  # what is already noted does not keep from noting more
    # Rows without a fix go before the projection: 0, 0 degrees would move its origin far from the site.
    _without_fix(check, measured)
    origin = in_metres(check)
    if len(check.problems) > before or not _heights(check):
        return None
    read = _with_table if "station_position" in check.raw.arrays else _without_table
    links = read(check, measured, part)
    if links is None:
        return None
    held = check.raw.arrays
    of_rows: dict[str, Any] = {name: held.pop(name) for name in OF_ROWS if name in held}
    if links.stations is not None:
        # From here on rows have positions of their own, as in a file of one static end.
        held[f"{links.static_end}_position"] = links.stations.position[of_rows["station"]]
        if links.stations.rotation is not None:
            held["rx_rotation"] = links.stations.rotation[of_rows["station"]]
    return replace(links, georeference=origin, **of_rows)


def _selected(check: Checker, measured: str, stations: Stations | None, part: Selection) -> Stations | None:
    """Leave out what `part` does not hold, and number runs and places anew; the stations that are left."""
    arrays = check.raw.arrays
    if arrays[measured].ndim:
        arrays, stations, notes = select(arrays, measured, stations, part, check.source)
        check.raw, check.notes = replace(check.raw, arrays=arrays), [*check.notes, *notes]
        runs = check.array("run", arrays[measured].shape[:1])
        arrays |= {} if runs is None else {"run": np.unique(runs, return_inverse=True)[1].reshape(-1)}
        arrays |= {} if "place" not in arrays else {"place": numbered(arrays["place"])}
    return stations


def _without_table(check: Checker, measured: str, part: Selection) -> Links | None:
    """A file of one static end, of an end at few places, of two ends that move, or of powers from nowhere."""
    for name in check.given(*STATION_FIELDS):
        return check.refuse(name, "given without station_position; expected the stations' places, (T, 3)")
    _selected(check, measured, None, part)
    arrays = check.raw.arrays
    rows = len(arrays[measured]) if arrays[measured].ndim else 0
    # Powers alone can be learned without the transmitter's place: channels and spectra need both ends.
    if measured in POWERS and not check.given("tx_position") and "rx_position" in arrays:
        check.notes.append("no tx_position: the transmitter's place is unknown")
        arrays["tx_position"] = np.full(3, np.nan)
        links, moving = Links("tx", unknown_transmitter=True), arrays["rx_position"]
    else:
        ends = [check.real(f"{end}_position", (3,), (rows, 3)) for end in ("rx", "tx")]
        if any(end is None for end in ends):
            return Links("tx")  # what is missing is said where positions are read
        rx, tx = (np.broadcast_to(np.asarray(end), (rows, 3)) for end in ends)
        links, moving = ends_of(check, rx, tx), np.hstack([rx, tx])
    if links.stations is None and moving.ndim == 2 and len(moving) == rows:
        place = numbered(moving)
        if len(np.unique(place)) < rows:  # a place visited twice is not learned from and tested on
            arrays["place"] = place
    return _valid(check, measured, links)


def _with_table(check: Checker, measured: str, part: Selection) -> Links | None:
    """A file with a table of stations, wide or long, as one row per link."""
    before = len(check.problems)
    stations = station_table(check, measured in (*POWERS, "csi"))
    ends = check.given("rx_position", "tx_position")
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
            measured, f"expected shape (S, {count}, ...), a column for each station, found {values.shape}; "
            "or say which station each row is of with `station` (S,)",
        )  # fmt: skip
    station = station_of_row(check, rows, count) if long else np.tile(np.arange(count), rows)
    row = np.repeat(np.arange(rows), 1 if long else count)
    stated = {name: check.real(name, (), (count,), (rows,)) for name in ("carrier_hz", "sensitivity_db")}
    positions = check.real(ends[0], (rows, 3))
    if static == "tx" and stations.rotation is not None:
        check.refuse("station_orientation", "transmitting stations are not turned; leave it out")
    if len(check.problems) > before or station is None or positions is None:
        return None
    arrays["place"] = numbered(positions)
    if not long:  # a wide row becomes as many rows as there are stations, side by side
        check.raw = _unrolled(check.raw, measured, count)
    check.raw.arrays["station"] = station
    for name, value in stated.items():
        if value is not None and value.ndim:  # of as many rows as stations, carriers are taken as of rows
            by_row = len(value) == rows and (rows != count or name == "carrier_hz")
            check.raw.arrays[name] = value[row if by_row else station]
            if by_row and rows == count and len(np.unique(value)) > 1:
                said = "as many values as rows and as stations; taken as one for each row"
                check.notes.append(f"{name}: {said}")
    for name in STATION_FIELDS[1:]:
        check.raw.arrays.pop(name, None)
    stations = by_carrier(check, _selected(check, measured, stations, part) or stations, measured in POWERS)
    absent = check.raw.attributes.get("absent", "auto")
    if long and absent == "silent":
        _with_absent(check, measured, len(stations))
    if absent == "auto" and measured == "rssi_db":
        _with_unlisted(check, stations, static)
    return _valid(check, measured, Links(static, stations))


def _with_absent(check: Checker, measured: str, count: int) -> None:
    """Add a row that was not heard for each place and station, of `count`, without one."""
    if measured != "rssi_db":
        return check.problems.add("dataset.absent", f"goes with levels [dB], not with {measured}")
    arrays = check.raw.arrays
    _, first, of_place = np.unique(arrays["place"], return_index=True, return_inverse=True)
    # Links are numbered place by station, so that those without a row are a set difference.
    lost = np.setdiff1d(np.arange(len(first) * count), of_place.reshape(-1) * count + arrays["station"])
    floor = _floors(arrays, count)
    # Minus infinity lies below whatever turns out to be the limit of hearing.
    _repeat(check, np.r_[: len(of_place), first[lost // count]], lost % count)
    if floor is not None and floor.ndim:
        check.raw.arrays["sensitivity_db"][len(of_place) :] = floor[lost % count]
    check.notes.append(f"{len(lost)} links without a row were not heard, as dataset.absent=silent says")


def _floors(arrays: dict[str, np.ndarray], count: int) -> np.ndarray | None:
    """The sensitivity (), or (T,) of `count` stations where their rows agree; None elsewhere, or without."""
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
    arrays["rssi_db"] = np.r_[arrays["rssi_db"][:heard].astype(np.float64), np.full(len(station), -np.inf)]
    check.raw = replace(check.raw, arrays=arrays)


def _with_unlisted(check: Checker, stations: Stations, static: End) -> None:
    """Add to lists of the strongest rows, twice as many as are listed, of stations that they leave out."""
    arrays, count = check.raw.arrays, len(stations)
    levels, of, floor = arrays["rssi_db"], arrays["station"], _floors(arrays, count)
    whole = levels.ndim == 1 and levels.dtype.kind in "iuf" and "mask" not in arrays
    heard = np.flatnonzero(np.isfinite(levels) if whole else np.zeros(0))
    if count < LEAST_LISTED or not len(heard) or ("sensitivity_db" in arrays and floor is None):
        return
    moment = moments(arrays["place"][heard], of[heard])
    moving = arrays[f"{OTHER[static]}_position"][heard].astype(np.float64)
    lists = Lists.of(moment, of[heard], levels[heard], moving, count)
    if not lists.recognised():
        return
    # Without a stated sensitivity, the weakest level heard anywhere bounds what lists leave out.
    floor = np.broadcast_to(levels[heard].min() if floor is None else floor, count)
    of_list, station, below = lists.unlisted(floor, stations.position, UNLISTED_EACH * len(heard))
    _repeat(check, np.r_[heard, heard[lists.first[of_list]]], station)
    check.raw.arrays["sensitivity_db"] = np.r_[levels[heard], below]
    check.notes.append(
        f"lists of the {lists.length} strongest of {count} stations: one that a full list leaves out is"
        f" below its weakest, in others below {floor.min():.4g} dB; {len(below)} such rows beside"
        f" {len(heard)} listed, those that tell most (dataset.absent=unknown takes none)"
    )


def _unrolled(raw: Raw, measured: str, count: int) -> Raw:
    """Rows of a wide file, one for each station."""
    rows = len(raw.arrays[measured])
    wide = {name: raw.arrays[name] for name in (measured, "mask") if name in raw.arrays}
    for name, array in wide.items():
        if array.shape[:2] == (rows, count):
            wide[name] = array.reshape(rows * count, *array.shape[2:])
    other = {name: array for name, array in raw.arrays.items() if name not in (*MEASUREMENTS, "mask")}
    return replace(raw, arrays=take_rows(other, np.repeat(np.arange(rows), count), rows) | wide)


def _without_fix(check: Checker, measured: str) -> None:
    """Leave out rows at exactly 0, 0 where all others are elsewhere; stations there are at unknown places."""
    arrays = check.raw.arrays
    degrees = "latitude" in arrays
    for name in ("latitude",) if degrees else check.given("rx_position", "tx_position"):
        pair = [arrays[one] for one in (name, "longitude") if one in arrays] if degrees else [arrays[name]]
        rows = len(arrays[measured]) if arrays[measured].ndim else 0
        if any(p.ndim != 2 - degrees or len(p) != rows or p.dtype.kind not in "iuf" for p in pair):
            continue
        place = np.column_stack(pair)[:, :2]
        null = (place == 0).all(axis=1)
        if null.all():
            continue
        least = NO_FIX_DEG if degrees else max(NO_FIX_M, 3 * np.ptp(place[~null], axis=0).max())
        if np.abs(np.median(place[~null], axis=0)).max() <= least:
            continue  # 0, 0 is a place, too, for who measures there
        _unknown_at_zero(check, degrees)
        if null.any():
            which = lines_of([str(name) for name in arrays["row_name"][null]])
            what = f"{'latitude and longitude' if degrees else 'x and y'} are 0: no fix"
            check.notes.append(Caution(f"{which}: {what}; these {null.sum()} of {rows} rows are left out"))
            check.raw = replace(check.raw, arrays=take_rows(arrays, np.flatnonzero(~null), rows))
            arrays = check.raw.arrays


def _unknown_at_zero(check: Checker, degrees: bool) -> None:
    """Stations at exactly 0, 0, where rows are elsewhere, stand at places that nobody knows."""
    arrays = check.raw.arrays
    names = ("station_latitude", "station_longitude") if degrees else ("station_position",)
    if not set(names) <= set(arrays):
        return
    at_zero = np.flatnonzero((np.column_stack([arrays[name] for name in names])[:, :2] == 0).all(axis=1))
    for name in names:
        arrays[name] = arrays[name].astype(np.float64)
        arrays[name][at_zero] = np.nan
    if len(at_zero):
        who = some([arrays["station_name"][i] if "station_name" in arrays else i for i in at_zero])
        check.notes.append(Caution(f"stations at 0, 0: {who}: no fix; their places are unknown"))


def _without_marks(check: Checker, values: np.ndarray, level: np.ndarray | None) -> np.ndarray:
    """Which of levels (S,) are marks for "not heard", (S,) bool: those that the file names, else found."""
    given = check.raw.attributes.get("not_heard")
    marks = not_heard(values) if given is None else np.atleast_1d(np.asarray(given, np.float64)).tolist()
    # `not_heard=[]` keeps minus infinity as a level, too.
    silent = np.isin(values, marks) | ((values == -np.inf) & (given is None or len(marks) > 0))
    floor = "sensitivity_db"
    if level is None and silent.any() and np.isfinite(values[~silent]).any():
        floor = f"{values[~silent & np.isfinite(values)].min():.4g} dB, the weakest"
    for mark in marks if given is None else ():
        share = f"{int((values == mark).sum())} of {len(values)} levels are exactly {round(mark, 6) + 0:g}"
        said = f"{share}, apart from all others: taken as not heard, below {floor}"
        say = "dataset.not_heard=[] keeps them as levels, sensitivity_db gives another limit"
        check.notes.append(Caution(f"{said}; {say}"))
    return silent


def _saturated(check: Checker, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Which of levels (S,) are at least the file's, or the found, level of saturation, (S,) bool."""
    given = check.raw.attributes.get("saturation_db", "auto")
    SATURATION.check("dataset.saturation_db", given)
    level = saturation(values[known]) if given == "auto" else None if given == "none" else float(given)
    if level is None:
        return np.zeros(len(values), bool)
    # Both in float32: a file's level may differ from the decimal setting by its rounding.
    above = known & (values.astype(np.float32) >= np.float32(level))
    said = f"{int(above.sum())} of {int(known.sum())} levels are"
    if given == "auto":
        said += f" exactly {level:.6g}, the most: a receiver in saturation? taken as at least that"
        check.notes.append(Caution(f"{said}; dataset.saturation_db=none takes them as measured"))
    else:
        check.notes.append(f"{said} {level:g} dB or more: saturated, taken as at least that")
    # Saturated rows hold the level itself: that bound is all that is known of them.
    check.raw.arrays["rssi_db"] = np.where(above, level, values)
    return above


def _valid(check: Checker, measured: str, links: Links) -> Links | None:
    """Rows without a missing value; censored ones hold the level that they lie below or above, masked."""
    values, arrays = check.raw.arrays[measured], check.raw.arrays
    level = check.real("sensitivity_db", (), (1,), values.shape[:1])
    if "sensitivity_db" in arrays and level is None:
        return None
    saturates = not isinstance(check.raw.attributes.get("saturation_db", "auto"), str)
    for name, said in (("sensitivity_db", level is not None), ("dataset.saturation_db", saturates)):
        if said and measured != "rssi_db":
            return check.refuse(name, f"goes with rssi_db, not with {measured}")
    floor = None
    if level is not None and values.ndim == 1:
        floor = np.broadcast_to(level, values.shape)
        floor = np.where(np.isnan(floor) & np.isfinite(values), values, floor)  # what was heard needs none
        if not (np.abs(floor) <= 400).all():
            return check.refuse("sensitivity_db", "expected dB between -400 and 400")
    arrays.pop("sensitivity_db", None)
    mask = arrays.get("mask")
    if mask is not None and (mask.shape != values.shape or mask.dtype.kind not in "biu"):
        return links  # said where the mask is read
    # A spectrum without power has no directions; where rows have paths they are a simulation's.
    silent = measured == "spectrum" and not is_big(values) and "path_offsets" not in arrays
    gaps = measured in POWERS or links.stations is not None  # what is not a number is missing there
    if values.dtype.kind not in "iufc" or values.ndim == 0 or not (gaps or mask is not None or silent):
        return links
    axes = tuple(range(1, values.ndim))
    unknown = np.isnan(values) if gaps else np.zeros(values.shape, bool)
    marked = np.ones(len(values), bool) if mask is None else mask.astype(bool).any(axis=axes)
    censored = saturated = np.zeros(len(values), bool)
    if measured == "rssi_db" and values.ndim == 1:
        unheard = _without_marks(check, values, floor) & marked
        heard = values[~unheard & np.isfinite(values)]
        unknown |= unheard
        if floor is not None:
            censored = unknown & marked
        elif unheard.any() and len(heard):
            floor, censored = np.full(len(values), heard.min()), unheard
        saturated = _saturated(check, values, ~unknown & marked)
        values = arrays[measured]
    if floor is not None:
        below = ~unknown & marked & (values < floor)
        # A value under the limit contradicts it: one of the two has another unit or receiver.
        if below.any():
            row = int(np.flatnonzero(below)[0])
            named = replace(links, station=arrays.get("station")).named([*map(str, arrays["row_name"])])[row]
            wrong = f"{named}: {measured} is {values[row]:.4g}, below {floor[row]:.4g}"
            return check.refuse("sensitivity_db", f"{wrong}, under which nothing is heard")
        highest, weakest = floor[censored].max(initial=-np.inf), values[~unknown & marked].min(initial=np.inf)
        if FAR_BELOW_DB < weakest - highest < np.inf:
            check.notes.append(
                f"sensitivity_db={highest:.4g} is {weakest - highest:.0f} dB below the weakest power heard: "
                "is it the receiver's? places where nothing was heard count as weaker still"
            )
        arrays[measured] = np.where(censored, floor, values)
    lost = (unknown if mask is None else unknown & mask.astype(bool)).any(axis=axes) & ~censored
    if mask is not None and lost.any():
        return links  # marked as measured, and is not: refused where values are read
    keep = marked & ~lost
    if silent and values.any():
        keep &= values.any(axis=axes)
    # As `Measurements.censored`: 1 too weak, -1 too strong, 0 measured.
    side = censored.astype(np.int8) - saturated
    if not (keep & (side == 0)).any():
        why = "nothing was heard in any row" if censored.any() else "nothing was measured"
        return check.refuse(measured, f"{why}; expected numbers")
    if not keep.all() or censored.any():
        none = " or without any power" if measured == "spectrum" else ""
        for flags, what in ((~keep, f"values are missing{none}"), (censored, NOT_HEARD)):
            check.notes += [f"{flags.sum()} of {len(keep)} {what}"] if flags.any() else []
        arrays, side = take_rows(arrays, np.flatnonzero(keep), len(keep)), side[keep]
        check.raw = replace(check.raw, arrays=arrays)
    if not side.any():
        return links
    arrays["mask"] = arrays.get("mask", np.ones(len(side), bool)).astype(bool) & (side == 0)
    return replace(links, censored=side)


def _heights(check: Checker) -> bool:
    """2-D positions get their stated height; False where it is missing (noted)."""
    arrays, before = check.raw.arrays, len(check.problems)
    for end in ("rx", "tx", "station"):
        name, height = f"{end}_position", f"{end}_height"
        flat = name in arrays and arrays[name].ndim in (1, 2) and arrays[name].shape[-1] == 2
        if not flat:
            if height in arrays:
                check.refuse(height, f"given, but {name} has three coordinates or is missing")
            continue
        if height not in arrays:
            check.refuse(name, f"two coordinates; expected three, or the height above ground as {height} [m]")
            continue
        above = check.real(height, (), (len(arrays[name]),) if arrays[name].ndim == 2 else ())
        if above is None:
            continue
        place = arrays[name].astype(np.float64)
        column = np.broadcast_to(above, place.shape[:-1])[..., None]
        arrays[name] = np.concatenate([place, column], axis=-1)
        arrays.pop(height)
    return len(check.problems) == before


def in_metres(check: Checker) -> Georeference | None:
    """Replace degrees in `check.raw` by positions (n, 2) [m]; None without any, or with a fault (noted)."""
    for prefix in ("", "station_"):
        pair = check.given(f"{prefix}latitude", f"{prefix}longitude")
        if len(pair) == 1:
            return check.refuse(pair[0], "given alone; expected latitude and longitude")
    arrays, before = check.raw.arrays, len(check.problems)
    if "latitude" not in arrays:
        if "station_latitude" in arrays:
            return check.refuse("station_latitude", "given without latitude and longitude of the other end")
        return _stated(check)
    if "station_position" in arrays:
        fault = "in metres beside places in degrees; expected station_latitude"
        return check.refuse("station_position", fault)
    places = {prefix: _read(check, prefix) for prefix in ("", "station_") if f"{prefix}latitude" in arrays}
    if len(check.problems) > before:
        return None
    # About the rows rather than the stations: a distant station must not distort the site.
    origin = Georeference.about(*places[""])
    end = _moving(check)
    for prefix, name in (("", end), ("station_", "station")):
        if prefix in places:
            known = np.isfinite(places[prefix][0])
            arrays[f"{name}_position"] = np.full((known.size, 2), np.nan)
            arrays[f"{name}_position"][known] = origin.from_degrees(*(part[known] for part in places[prefix]))
            if f"{name}_height" not in arrays:
                arrays[f"{name}_height"] = np.array(0.0)
                check.notes.append(f"no {name}_height: taken as 0 m")
            del arrays[f"{prefix}latitude"], arrays[f"{prefix}longitude"]
    check.notes += degree_warnings(*places[""])
    where = f"{origin.latitude:g}, {origin.longitude:g} degrees"
    check.notes.append(f"positions are metres east and north of {where}")
    return origin


def _stated(check: Checker) -> Georeference | None:
    """The origin of positions in metres, where attributes of the file say where on Earth it lies."""
    degrees = [check.raw.attributes.get(f"origin_{name}") for name in ("latitude", "longitude")]
    if degrees == [None, None]:
        return None
    try:
        return Georeference(*(float(value) for value in degrees))  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        return check.refuse("origin_latitude", f"with origin_longitude {degrees}: expected degrees ({error})")


def _read(check: Checker, prefix: str) -> tuple[np.ndarray, np.ndarray]:
    latitude = check.real(f"{prefix}latitude", (None,))
    longitude = None if latitude is None else check.real(f"{prefix}longitude", latitude.shape)
    if latitude is None or longitude is None:
        return np.zeros(0), np.zeros(0)
    absent = np.isnan(latitude) & np.isnan(longitude) & bool(prefix)  # a station whose place nobody knows
    # Zeros stand in for places that nobody knows, which would be refused as no degrees.
    fault = bad_degrees(*np.where(absent, 0, (latitude, longitude)))
    if fault:
        check.refuse(f"{prefix}latitude", "row {}: {}".format(*fault))
    return latitude, longitude


def _moving(check: Checker) -> str:
    """The end that degrees are of: the one with a height, or the one without a position; the receiver."""
    return "tx" if check.given("tx_height", "rx_position") else "rx"

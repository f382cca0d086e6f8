"""Latitude and longitude of a file as positions in metres about an origin of its own."""

from __future__ import annotations

import numpy as np

from gsparc.data.checks.plausibility import degree_warnings
from gsparc.data.links.georeference import Georeference, bad_degrees
from gsparc.data.own_checks import Checker


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
        return check.refuse(
            "station_position", "in metres beside places in degrees; expected station_latitude"
        )
    places = {prefix: _read(check, prefix) for prefix in ("", "station_") if f"{prefix}latitude" in arrays}
    if len(check.problems) > before:
        return None
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
    check.notes.append(
        f"positions are metres east and north of {origin.latitude:g}, {origin.longitude:g} degrees"
    )
    return origin


def _stated(check: Checker) -> Georeference | None:
    """The origin of positions in metres, where attributes of the file say where on Earth it lies."""
    given = [check.raw.attributes.get(f"origin_{name}") for name in ("latitude", "longitude")]
    if given == [None, None]:
        return None
    try:
        return Georeference(*(float(value) for value in given))  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        return check.refuse("origin_latitude", f"with origin_longitude {given}: expected degrees ({error})")


def _read(check: Checker, prefix: str) -> tuple[np.ndarray, np.ndarray]:
    names = f"{prefix}latitude", f"{prefix}longitude"
    latitude, longitude = (check.real(name, (None,)) for name in names)
    if latitude is None or longitude is None:
        return np.zeros(0), np.zeros(0)
    if len(latitude) != len(longitude):
        check.refuse(names[1], f"{len(longitude)} values for {len(latitude)} latitudes")
        return np.zeros(0), np.zeros(0)
    absent = np.isnan(latitude) & np.isnan(longitude) & bool(prefix)  # a station whose place nobody knows
    for row in np.flatnonzero(~absent).tolist() if bad_degrees(latitude, longitude) else ():
        fault = bad_degrees(latitude[row], longitude[row])
        if fault:
            check.refuse(names[0], f"row {row}: {fault}")
            break
    none = (latitude == 0) & (longitude == 0)
    # (0, 0) is a place, too, for who measures there.
    if none.any() and max(abs(np.median(latitude)), abs(np.median(longitude))) > 1:
        row = int(none.argmax())
        check.refuse(names[0], f"row {row}: latitude and longitude are 0: no fix; leave the row out")
    return latitude, longitude


def _moving(check: Checker) -> str:
    """The end that degrees are of: the one with a height, or the one without a position; the receiver."""
    for end, other in (("tx", "rx"), ("rx", "tx")):
        if check.given(f"{end}_height") or check.given(f"{other}_position"):
            return end
    return "rx"

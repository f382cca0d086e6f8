"""Positions of a file as three coordinates in metres; rows without a fix are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.base.errors import Caution, Severe, list_first, name_row_ranges
from gsparc.data.assemble import FARTHEST
from gsparc.data.georeference import ON_EARTH, Georeference, find_invalid_coordinate
from gsparc.data.outliers import FEW
from gsparc.data.selection import take_rows
from gsparc.tables.arrays import name_rows_by_number
from gsparc.tables.checks.plausibility import degree_warnings
from gsparc.tables.own_checks import Checker

DIGITS = 2  # of an origin's degrees, 1.1 km: drives with a few rows more or less have one
NO_FIX_DEG, NO_FIX_M = 1.0, 1e4  # from 0, 0 to the median of all other rows, at least


def convert_positions(check: Checker, measured: str) -> tuple[bool, Georeference | None]:
    """Replace positions in `check.raw` by (n, 3) [m]; whether all went well,
    and the origin of degrees.

    Args:
        check: of the file; takes notes of rows that are left out, and what is wrong.
        measured: name of the measurement.
    """
    before = len(check.problems)  # what is already noted does not keep from noting more
    # Rows without a fix go before the projection: 0,
    # 0 degrees would move its origin far from the site.
    _without_fix(check, measured)
    origin = _in_metres(check)
    return len(check.problems) == before and _heights(check), origin


def _without_fix(check: Checker, measured: str) -> None:
    """Leave out rows at 0, 0 where all others are elsewhere and, of few, where nothing can be."""
    arrays = check.raw.arrays
    degrees = "latitude" in arrays
    for name in ("latitude",) if degrees else check.present("rx_position", "tx_position"):
        pair = (
            [arrays[key] for key in (name, "longitude") if key in arrays]
            if degrees
            else [arrays[name]]
        )
        rows, kinds = len(arrays[measured]), {p.dtype.kind for p in pair}
        if any(p.ndim != 2 - degrees or len(p) != rows for p in pair) or not kinds <= {*"iuf"}:
            continue
        if len(pair) < 1 + degrees:  # refused where degrees are read
            continue
        place = np.column_stack(pair)[:, :2].astype(np.float64)
        null, earth = (
            (place == 0).all(axis=1),
            np.array(ON_EARTH if degrees else [(-FARTHEST, FARTHEST)] * 2),
        )
        off = np.asarray(~((place >= earth[:, 0]) & (place <= earth[:, 1])).all(axis=1))
        fixes = place[~(null | off)]
        if not len(fixes):
            continue
        faults = dict[str, np.ndarray]()
        least = NO_FIX_DEG if degrees else max(NO_FIX_M, 3 * np.ptp(fixes, axis=0).max())
        if np.abs(np.median(fixes, axis=0)).max() > least:  # else 0, 0 is a place like any other
            _unknown_at_zero(check, degrees)
            faults[f"{'latitude and longitude' if degrees else 'x and y'} are 0: no fix"] = null
        middle = np.median(fixes, axis=0)
        swapped = (np.abs(place[:, ::-1] - middle) < NO_FIX_DEG).all(axis=1) & degrees
        swapped &= (np.abs(place - middle) > NO_FIX_DEG).any(axis=1)
        if 2 * swapped.sum() < rows:
            faults["latitude and longitude are exchanged"] = swapped
        # One value that repeats is a mark of a logger; several are faults only where they are few.
        if off.sum() <= max(1, FEW * rows) or (
            2 * off.sum() < rows and not np.ptp(place[off], axis=0).any()
        ):
            x, y = place[off.argmax()]
            faults[f"no such place on Earth, ({x:g}, {y:g}) {'degrees' if degrees else 'm'}"] = off
        for fault, out in [(key, out) for key, out in faults.items() if out.any()]:
            which = name_row_ranges([str(name) for name in arrays["row_name"][out]])
            check.notes.append(
                Caution(f"{which}: {fault}; these {out.sum()} of {rows} rows are left out")
            )
        keep = ~np.any([*faults.values()], axis=0)
        if faults and not keep.all():
            check.raw = replace(check.raw, arrays=take_rows(arrays, np.flatnonzero(keep), rows))
            arrays = check.raw.arrays


def _unknown_at_zero(check: Checker, degrees: bool) -> None:
    """Stations at exactly 0, 0, where rows are elsewhere, stand at places that nobody knows."""
    arrays = check.raw.arrays
    names = ("station_latitude", "station_longitude") if degrees else ("station_position",)
    if not set(names) <= set(arrays) or len({len(arrays[name]) for name in names}) > 1:
        return
    at_zero = np.flatnonzero(
        (np.column_stack([arrays[name] for name in names])[:, :2] == 0).all(axis=1)
    )
    for name in names:
        arrays[name] = arrays[name].astype(np.float64)
        arrays[name][at_zero] = np.nan
    if len(at_zero):
        who = list_first(
            [arrays["station_name"][i] if "station_name" in arrays else i for i in at_zero]
        )
        check.notes.append(Caution(f"stations at 0, 0: {who}: no fix; their places are unknown"))


def _heights(check: Checker) -> bool:
    """2-D positions get their stated height; False where it is missing (noted)."""
    arrays, before = check.raw.arrays, len(check.problems)
    for end in ("rx", "tx", "station"):
        name, height = f"{end}_position", f"{end}_height"
        flat = name in arrays and arrays[name].shape[-1] == 2
        if height in arrays and not flat:
            check.refuse(height, f"given, but {name} has three coordinates or is missing")
        elif height not in arrays and flat:
            check.refuse(
                name, f"two coordinates; expected three, or the height above ground as {height} [m]"
            )
        elif flat and (above := check.read_real(height, (), arrays[name].shape[:-1])) is not None:
            place = arrays[name].astype(np.float64)
            column = np.broadcast_to(above, place.shape[:-1])[..., None]
            arrays[name] = np.concatenate([place, column], axis=-1)
            arrays.pop(height)
    return len(check.problems) == before


def _in_metres(check: Checker) -> Georeference | None:
    """Degrees in `check.raw` replaced by positions (n, 2) [m]; None without any,
    or with a fault (noted).
    """
    for prefix in ("", "station_"):
        pair = check.present(f"{prefix}latitude", f"{prefix}longitude")
        if len(pair) == 1:
            return check.refuse(pair[0], "given alone; expected latitude and longitude")
    arrays, before = check.raw.arrays, len(check.problems)
    if "latitude" not in arrays:
        if "station_latitude" in arrays:
            return check.refuse(
                "station_latitude", "given without latitude and longitude of the other end"
            )
        return _stated(check)
    if "station_position" in arrays:
        fault = "in metres beside places in degrees; expected station_latitude"
        return check.refuse("station_position", fault)
    places = {
        prefix: _read(check, prefix) for prefix in ("", "station_") if f"{prefix}latitude" in arrays
    }
    if len(check.problems) > before:
        return None
    # About the rows rather than the stations: a distant station must not distort the site.
    # Of different ones, so that copies or a few rows more leave it, and all that is drawn, alone.
    latitude, longitude = np.unique(places[""], axis=1)
    origin = Georeference.from_coordinates(latitude, longitude, DIGITS)
    # Of the end with a height, or the one without a position; else of the receiver.
    end = "tx" if check.present("tx_height", "rx_position") else "rx"
    for prefix, name in (("", end), ("station_", "station")):
        if prefix in places:
            valid = np.isfinite(places[prefix][0])
            arrays[f"{name}_position"] = np.full((valid.size, 2), np.nan)
            arrays[f"{name}_position"][valid] = origin.from_degrees(
                *(part[valid] for part in places[prefix])
            )
            if f"{name}_height" not in arrays:
                arrays[f"{name}_height"] = np.array(0.0)
                check.notes.append(f"no {name}_height: taken as 0 m")
            del arrays[f"{prefix}latitude"], arrays[f"{prefix}longitude"]
    check.notes += map(Severe, degree_warnings(*places[""]))
    where = f"latitude {origin.latitude:g}, longitude {origin.longitude:g}"
    check.notes.append(f"positions are metres east and north of {where}")
    return origin


def _stated(check: Checker) -> Georeference | None:
    """The origin of positions in metres, where attributes of the file say where
    on Earth it lies.
    """
    degrees = [check.raw.attributes.get(f"origin_{name}") for name in ("latitude", "longitude")]
    if degrees == [None, None]:
        return None
    try:
        return Georeference(*(float(value) for value in degrees))  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        return check.refuse(
            "origin_latitude", f"with origin_longitude {degrees}: expected degrees ({error})"
        )


def _read(check: Checker, prefix: str) -> tuple[np.ndarray, np.ndarray]:
    latitude = check.read_real(f"{prefix}latitude", (None,))
    longitude = None if latitude is None else check.read_real(f"{prefix}longitude", latitude.shape)
    if latitude is None or longitude is None:
        return np.zeros(0), np.zeros(0)
    # A station whose place nobody knows
    absent = np.isnan(latitude) & np.isnan(longitude) & bool(prefix)
    # Zeros stand in for places that nobody knows, which would be refused as no degrees.
    fault = find_invalid_coordinate(*np.where(absent, 0, (latitude, longitude)))
    if fault:
        called = name_rows_by_number(len(latitude)) if prefix else check.raw.arrays["row_name"]
        check.refuse(f"{prefix}latitude", f"{called[fault[0]]}: {fault[1]}")
    return latitude, longitude

"""The ends of the links of a file: which stands still, at which places, named how,
at which carriers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsparc.data.schema import ENDS, OTHER, End, StaticEnds, Stations
from gsparc.data.spacing import number_places
from gsparc.tables.own_checks import HIGHEST_HZ, LOWEST_HZ, Checker

# Of a station's beam, in the order of `Stations.sector`.
SECTOR = (
    "station_azimuth",
    "station_tilt",
    "station_width",
    "station_thickness",
    "station_power_db",
    "station_site",
)
# Of a list of stations, beside their places
PER_STATION = ("sensitivity_db", "carrier_hz", *SECTOR)
FULL_TURN = 360.0
LINKS_PER_STATION = 8  # fewer rows at each distinct place of an end: that end moves


def find_static_end(check: Checker, rx: np.ndarray, tx: np.ndarray) -> StaticEnds:
    """Find which end stands still, at one place or at few, whose rows are then numbered; None:
    both move.
    """
    ends: dict[End, np.ndarray] = {"tx": tx, "rx": rx}
    places = {end: np.unique(where, axis=0, return_inverse=True) for end, where in ends.items()}
    few: End = min(ends, key=lambda end: len(places[end][0]))
    table, which = places[few]
    if len(table) == 1:
        return StaticEnds("rx" if len(places["rx"][0]) == 1 else "tx")
    if len(table) * LINKS_PER_STATION > len(rx) or len(table) * 2 > len(places[OTHER[few]][0]):
        return StaticEnds(None)
    check.notes.append(
        f"the {ENDS[few]} stands at {len(table)} places: taken as {len(table)} stations"
    )
    check.raw.arrays["station"] = which.reshape(-1).astype(np.int64)
    check.raw.arrays["place"] = number_places(ends[OTHER[few]])
    return StaticEnds(few, Stations(table, tuple(str(i) for i in range(len(table)))))


def read_station_table(check: Checker, may_miss: bool = False) -> Stations | None:
    """Read the table that a file gives; None where something is wrong with it (noted).

    Places may be missing, NaN throughout, where powers or channels alone are told by the stations.
    """
    arrays = check.raw.arrays
    positions = arrays["station_position"]
    no_place = np.isnan(positions[:, :2]).all(axis=1) & may_miss
    arrays["station_position"] = np.where(no_place[:, None], 0, positions)
    places = check.read_positions("station_position", None)
    if places is None:
        return None
    count = len(places)
    places[no_place] = np.nan
    names, label = (check.raw.arrays.get(f"station_{field}") for field in ("name", "label"))
    for field, texts in (("station_name", names), ("station_label", label)):
        if texts is not None and not check.has_shape(field, texts, (count,)):
            return None
    called = tuple(map(str, range(count) if names is None else names))
    for name in sorted({name for name in called if called.count(name) > 1}):
        return check.refuse("station_name", f"{name!r} twice; expected a name for each station")
    turned = check.read_real("station_orientation", (count, 4))
    rotation = None if turned is None else check.to_matrices("station_orientation", turned, called)
    if turned is not None and rotation is None:
        return None
    parts = [check.read_real(name, (count,)) for name in SECTOR]
    sector = None
    if any(part is not None for part in parts):
        sector = np.stack([np.full(count, np.nan) if part is None else part for part in parts], 1)
        wrong = np.abs(sector[:, :4]).max(initial=0, where=np.isfinite(sector[:, :4]))
        if wrong > FULL_TURN:
            return check.refuse(
                "station_azimuth", f"{wrong:g}; expected degrees, none beyond {FULL_TURN:g}"
            )
    labels = None if label is None else tuple(map(str, label))
    return Stations(places, called, rotation, sector=sector, label=labels)


def read_station_of_row(check: Checker, rows: int, count: int) -> np.ndarray | None:
    """Return the station (S,) int64 of every row."""
    index = check.read_array("station", (rows,))
    if index is None:
        return None
    out = np.flatnonzero((index < 0) | (index >= count))
    if len(out):
        fault = f"row {out[0]} is of station {index[out[0]]}; there are 0 to {count - 1}"
        return check.refuse("station", fault)
    return index.astype(np.int64)


ONE_CARRIER = 1.05  # channels of one band within this ratio are one carrier to a field of powers


def _of_one(
    check: Checker, station: np.ndarray, carrier: np.ndarray, names: Sequence[str]
) -> np.ndarray:
    """Carriers (n,) [Hz] of links, those of one station that lie close together at their middle."""
    different, which = np.unique(carrier, return_inverse=True)
    bands: list[int] = []
    for value in different:
        start = different[bands.index(bands[-1])] if bands else value
        bands.append((bands[-1] if bands else 0) + int(value > ONE_CARRIER * start))
    band = np.array(bands)[which.reshape(-1)]
    pairs = np.unique(np.stack([station, band, which.reshape(-1)], 1), axis=0)[:, :2]
    carriers, count = np.unique(pairs, axis=0, return_counts=True)
    if count.max() == 1:
        return carrier
    most = names[carriers[count.argmax(), 0]]
    note = f"station {most} at {count.max()} carriers within {100 * (ONE_CARRIER - 1):.0f} % is one"
    check.notes.append(
        f"{note}, and the like; dataset.columns.station=STATION+CARRIER tells them apart"
    )
    ends = [different[np.array(bands) == number] for number in range(bands[-1] + 1)]
    return np.array([(end[0] + end[-1]) / 2 for end in ends])[band]


def split_by_carrier(check: Checker, stations: Stations, hopping: bool) -> Stations:
    """Part stations at several carriers, one for each; where `hopping`,
    carriers of a band are one.
    """
    arrays = check.raw.arrays
    carrier = arrays.get("carrier_hz")
    if carrier is None or carrier.ndim == 0:
        return stations
    wrong = ~((carrier >= LOWEST_HZ) & (carrier <= HIGHEST_HZ))
    if wrong.any():
        check.refuse("carrier_hz", f"{carrier[np.argmax(wrong)]:g}; expected Hz (not MHz or GHz)")
        check.problems.raise_if_any()
    carrier = _of_one(check, arrays["station"], carrier, stations.name) if hopping else carrier
    pairs, which = np.unique(np.stack([arrays["station"], carrier], 1), axis=0, return_inverse=True)
    first, carrier = pairs[:, 0].astype(np.int64), pairs[:, 1]
    arrays.pop("carrier_hz")
    if len(np.unique(carrier)) == 1:
        arrays["carrier_hz"] = np.array(carrier[0])
        return stations
    several = np.bincount(first)[first] > 1  # a station of one carrier keeps its name
    called = zip(first, carrier, several, strict=True)
    names = [stations.name[i] + (f" at {c / 1e6:g} MHz" if more else "") for i, c, more in called]
    arrays["station"] = which.reshape(-1).astype(np.int64)
    return replace(stations.subset(first, names), carrier_hz=carrier)

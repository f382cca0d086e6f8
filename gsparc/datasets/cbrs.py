"""Received powers of the six CBRS cells of a campus on two phones (Geo2SigMap, Duke University).

The release is a table, `Duke_CBRS.csv`, a row per reading: `PCI` (a letter for each cell),
`latitude`, `longitude` [deg], `device`, `rsrp` [dBm]. Masts, beams and carriers stand in the
release's notebooks, heights nowhere. Its authors score pixels of 4 m in a box of 512 m about each
mast, each pixel the mean of its milliwatts (arXiv 2312.14303).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError
from gsparc.base.limits import POSITIVE, or_null
from gsparc.data.georeference import Georeference
from gsparc.datasets.campaign import Campaign
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.tables.raw import Raw

# Latitude and longitude [deg] of masts, and of the north-western corner of the box about each
MASTS = ((35.999186254897836, -78.9397858960648), (36.00307128210248, -78.93706070613855))
CORNERS = ((36.001483241320656, -78.94273733701348), (36.005429554748495, -78.93998431793196))
BOX_M = 512.0
CELLS = {  # mast, azimuth [deg], carrier [MHz]
    "A": (0, 212, 3690),
    "B": (0, 212, 3640),
    "C": (0, 30, 3580),
    "D": (0, 30, 3560),
    "E": (1, 216, 3690),
    "F": (1, 216, 3640),
}
MAST_M, PHONE_M = 20.0, 1.5  # above ground, assumed
HEADS = ("PCI", "latitude", "longitude", "device", "rsrp")


def read_cbrs(path: str | Path, phone: str | None = None, pixel_m: float | None = 4.0) -> Raw:
    """Read the table of the release, or a part of it with the same heads.

    Args:
        path: *.csv.
        phone: the one whose rows are read; None: both.
        pixel_m: side of the pixels of the published box [m]; None: rows as they were logged, of
            the whole campus.

    Returns:
        `latitude`, `longitude` (S,) [deg], `station`, `rssi_db` [dBm], `device` (S,); of stations
        (T,) names, places, azimuths, sites, carriers; heights are assumed.

    Raises:
        DataError: another table, an unknown cell, or a phone that it does not hold.
    """
    or_null(POSITIVE).check("dataset.pixel_m", pixel_m)
    from gsparc.tables.opening import read_sheet  # here, as pandas takes half a second to import

    sheet = read_sheet(path)
    if missing := [head for head in HEADS if head not in sheet.heads]:
        raise DataError(f"{path}, line 1: no column {' and '.join(missing)}")
    numbers = [sheet.numbers(head) for head in ("latitude", "longitude", "rsrp")]
    sheet.problems.raise_if_any()
    cell, device = sheet.words("PCI"), sheet.words("device")
    if unknown := {*cell.tolist()} - {*CELLS}:
        raise DataError(f"{path}, PCI: {min(unknown)!r} is none of {', '.join(CELLS)}")
    kept = np.full(len(cell), True) if phone is None else device == phone
    if not kept.any():
        known = " or ".join(np.unique(device))
        raise DataError(f"{path}: no row of dataset.phone={phone}; say {known}")
    latitude, longitude, level = (np.asarray(column)[kept] for column in numbers)
    names, station = np.unique(cell[kept], return_inverse=True)
    cells = np.array([CELLS[name] for name in names.tolist()])
    place = np.array(MASTS)[cells[:, 0]]
    phones, number = np.unique(device[kept], return_inverse=True)
    rows: tuple[np.ndarray, ...] = latitude, longitude, level, station, number
    if pixel_m is not None:
        rows = average_pixels(rows, cells[:, 0], pixel_m)
    arrays = dict(zip(("latitude", "longitude", "rssi_db", "station"), rows[:4], strict=True))
    arrays |= {"device": phones[rows[4]]} if len(phones) > 1 else {}
    about = {
        "rx_height": np.array(PHONE_M),
        "station_name": names,
        "station_latitude": place[:, 0],
        "station_longitude": place[:, 1],
        "station_height": np.array(MAST_M),
        "station_site": cells[:, 0],
        "station_azimuth": cells[:, 1].astype(float),
        "carrier_hz": cells[:, 2] * 1e6,
    }
    return Raw({**arrays, **about}, {"name": "cbrs", "layout": "cbrs"})


def average_pixels(
    rows: tuple[np.ndarray, ...], mast: np.ndarray, pixel_m: float
) -> tuple[np.ndarray, ...]:
    """Return the same of pixels in the masts' boxes: levels are means of milliwatts.

    Args:
        rows: latitude, longitude [deg], level [dBm], numbers of station and device, (S,) each.
        mast: (T,) of stations.
        pixel_m: side of a pixel [m].
    """
    latitude, longitude, level_db, station, device = rows
    parts = list[tuple[np.ndarray, ...]]()
    for number, corner in enumerate(CORNERS):
        origin, own = Georeference(*corner), np.flatnonzero(mast[station] == number)
        east_north = origin.from_degrees(latitude[own], longitude[own])
        pixel = np.floor((east_north + np.array([0, BOX_M])) / pixel_m)
        inside = ((pixel >= 0) & (pixel < BOX_M / pixel_m)).all(1)
        own, key = own[inside], np.c_[pixel, station[own], device[own]][inside].astype(int)
        keys, group = np.unique(key, axis=0, return_inverse=True)
        power = np.bincount(group, from_decibels(level_db[own])) / np.bincount(group)
        degrees = origin.to_degrees((keys[:, :2] + 0.5) * pixel_m - np.array([0, BOX_M]))
        parts += [(*degrees, to_decibels(power), keys[:, 2], keys[:, 3])]
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


class Cbrs(Campaign):
    """Powers of six cells on two phones; settings of `read_cbrs` and of `Campaign`."""

    choice, reader = "cbrs", staticmethod(read_cbrs)

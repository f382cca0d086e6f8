"""A drive test with GPS as people keep it: a table of rows, one of stations,
and places to ask about.
"""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from releases import release

from gsparc.datasets.powder import read_powder

STATIONS = ("ebc-nuc1-b210", "madsen-nuc2-b210")


@dataclass(frozen=True)
class Drive:
    """Files of a drive test.

    Attributes:
        rows, sites, places: tables of measurements, of stations, and of places that are in no row.
        level_db: (n, T) measured there [dB].
        learned_db: (m, T) measured in `rows`.
    """

    rows: Path
    sites: Path
    places: Path
    level_db: np.ndarray
    learned_db: np.ndarray


def write_table(path: Path, heads: Iterable[str], rows: Iterable[Iterable[object]]) -> Path:
    """A CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(heads)
        writer.writerows(rows)
    return path


def city_drive(folder: Path, count: int = 300, held: int = 60) -> Drive:
    """Rows of the city at two stations; `held` of them are left for asking."""
    arrays = read_powder(release("real/powder-rss-462mhz.npz")).arrays
    names = list(map(str, arrays["station_name"]))
    chosen = [names.index(station) for station in STATIONS]
    level = arrays["rssi_db"][:, chosen].astype(np.float64)
    heard = np.flatnonzero(np.isfinite(level).all(axis=1))
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(heard, count, replace=False))
    asked = np.zeros(count, bool)
    asked[rng.choice(count, held, replace=False)] = True
    degrees = np.stack([arrays["latitude"], arrays["longitude"]], axis=1)[rows]
    level = level[rows].round(2)
    table = np.array(
        [[*map(repr, d), *map(str, p)] for d, p in zip(degrees.tolist(), level, strict=True)]
    )
    sites = [
        [station, arrays["station_latitude"][i], arrays["station_longitude"][i], 10.0]
        for station, i in zip(STATIONS, chosen, strict=True)
    ]
    heads = ["Latitude", "Longitude", *(f"RSRP_{station} [dBm]" for station in STATIONS)]
    return Drive(
        write_table(folder / "drive.csv", heads, table[~asked]),
        write_table(folder / "sites.csv", ["name", "lat", "lon", "height"], sites),
        write_table(folder / "places.csv", heads[:2], table[asked, :2]),
        level[asked],
        level[~asked],
    )

"""A drive test with GPS as people keep it: a table of rows, one of stations,
and places to ask about.
"""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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

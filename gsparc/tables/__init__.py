"""Tables of measurements (text, Parquet, records): one row for each place,
or for each place and station.

`read.parse_table` reads one; it is not imported here, as pandas takes half a second.
"""

from __future__ import annotations

from pathlib import Path

from gsparc.tables.arrays import ARRAY_SUFFIXES


def is_table(path: str | Path) -> bool:
    """Tell whether a file may be one: its name is not that of arrays."""
    return Path(path).suffix.lower() not in ARRAY_SUFFIXES

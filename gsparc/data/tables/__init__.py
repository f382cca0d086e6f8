"""Tables of measurements (CSV, TSV, Parquet): one row for each place, or for each place and station.

`read.parse_table` reads one; it is not imported here, as pandas takes half a second.
"""

from __future__ import annotations

from pathlib import Path

TEXT_SUFFIXES = (".csv", ".tsv", ".txt")
TABLE_SUFFIXES = (*TEXT_SUFFIXES, ".parquet")


def is_table(path: str | Path) -> bool:
    """Tell whether a file's name says that it is one."""
    return Path(path).suffix.lower() in TABLE_SUFFIXES

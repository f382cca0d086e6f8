"""Tables as people keep them."""

import csv
from collections.abc import Iterable
from pathlib import Path


def write_table(path: Path, heads: Iterable[str], rows: Iterable[Iterable[object]]) -> Path:
    """A CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(heads)
        writer.writerows(rows)
    return path

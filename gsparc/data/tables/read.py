"""From a file that is a table to the named arrays of the schema."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gsparc.data.errors import DataError, Problems
from gsparc.data.raw import Raw
from gsparc.data.tables import TEXT_SUFFIXES
from gsparc.data.tables.arrays import Builder
from gsparc.data.tables.columns import choose, schema_unit
from gsparc.data.tables.sheet import Sheet, read_parquet
from gsparc.data.tables.stations import read_stations
from gsparc.data.tables.text import read_text

log = logging.getLogger(__name__)

NOTHING: Mapping[str, object] = {}


@dataclass(frozen=True)
class Table:
    """What a table holds.

    Attributes:
        raw: arrays named as in the schema.
        notes: what was guessed or converted, one line each.
    """

    raw: Raw
    notes: tuple[str, ...]


def read_table(
    path: str | Path, columns: Mapping[str, object] = NOTHING, stations_file: str | Path | None = None
) -> Raw:
    """The arrays of a table; what was guessed is logged.

    Args:
        path: *.csv, *.tsv, *.txt or *.parquet.
        columns: column by quantity (`heads.KINDS`) where a guess will not do; a number stands for all rows,
            a pattern with a `*` for a column per station.
        stations_file: a second table: name, x, y, z or latitude, longitude, height of each station.

    Raises:
        DataError: all problems, with row and column.
    """
    table = understand_table(path, columns, stations_file)
    for note in table.notes:
        log.info("%s: %s", path, note)
    return table.raw


def understand_table(
    path: str | Path, columns: Mapping[str, object] = NOTHING, stations_file: str | Path | None = None
) -> Table:
    """As `read_table`, with the notes."""
    sheet, notes = sheet_of(path)
    problems = Problems(path)
    listed = None
    if stations_file is not None:
        second, _ = sheet_of(stations_file)
        listed, said = read_stations(second, problems)
        notes += said
        problems.raise_if_any()
    chosen, guessed = choose(sheet, columns, problems, () if listed is None else listed.names)
    problems.raise_if_any()
    builder = Builder(sheet, chosen, listed, problems)
    arrays = builder.build()
    problems.raise_if_any()
    level = chosen["rssi_db"][0] if "rssi_db" in chosen else None
    about = {} if level is None or level.unit is None else {"level_unit": schema_unit(level)}
    about |= {"level_unit": "dBW"} if "rssi" in chosen else {}
    return Table(Raw(arrays, about), (*notes, *guessed, *builder.notes))


def sheet_of(path: str | Path) -> tuple[Sheet, list[str]]:
    """The cells of a table, and notes on what was recognised.

    Raises:
        DataError: no such file, another ending, or no table.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected *.csv, *.tsv, *.txt or *.parquet")
    if path.suffix.lower() == ".parquet":
        return read_parquet(str(path)), []
    if path.suffix.lower() not in TEXT_SUFFIXES:
        raise DataError(f"{path}: expected a name ending in .csv, .tsv, .txt or .parquet")
    return read_text(path)

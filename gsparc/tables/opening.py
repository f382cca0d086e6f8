"""From files, of text or Parquet, to `Sheet`: delimiters, banners, comments, decimal marks,
limits.
"""

from __future__ import annotations

import codecs
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pandas as pd

from gsparc.base.errors import DataError, Problems, absent, readable
from gsparc.base.files import check_fetched
from gsparc.base.limits import most_text
from gsparc.tables import is_table
from gsparc.tables.cells import unfold_cells
from gsparc.tables.raw import ARRAY_SUFFIXES
from gsparc.tables.records import read_records
from gsparc.tables.sheet import Sheet
from gsparc.tables.text import check_bytes, read_text


def read_frame(path: Path, kind: str) -> Sheet:
    """Read the columns of a file of one of `FRAMES`.

    Raises:
        DataError: pyarrow is missing, or the file is damaged or empty.
    """
    source = str(path)
    if kind != RECORDS and find_spec("pyarrow") is None:
        raise DataError(f"{source}: {kind} needs pyarrow; say: pip install 'gsparc[tables]'")
    # Pyarrow and pandas raise anything
    with readable(source, f"damaged or not a {kind} file", Exception):
        frame = FRAMES[kind](path)
    unnamed = [i for i, name in enumerate(frame.index.names) if name is None]
    frame = frame.reset_index(level=unnamed, drop=True) if unnamed else frame
    # Pandas sets some columns aside as an index: columns all the same
    if frame.index.names[0] is not None:
        frame = frame.reset_index(allow_duplicates=True)
    frame.columns = frame.columns.astype(str)
    for name in frame.columns[frame.columns.duplicated()]:
        raise DataError(f"{source}: two columns are named {name!r}; rename one")
    if frame.empty:
        raise DataError(f"{source}: no rows")
    return Sheet(source, frame, tuple(f"row {i}" for i in range(len(frame))))


RECORDS = "JSON, GPX or KML"
FRAMES: dict[str, Callable[[Path], pd.DataFrame]] = {
    "Parquet": pd.read_parquet,
    "Feather": pd.read_feather,
    RECORDS: read_records,
}
STARTS = {b"PAR1": "Parquet", b"ARRO": "Feather", **dict.fromkeys((b"{", b"[{", b"<"), RECORDS)}
PEEKED = 64  # bytes that tell what a file is


def read_sheet(path: str | Path, problems: Problems | None = None) -> Sheet:
    """Read the cells of a table, a column for each number of one,
    with notes on what was recognised.

    Args:
        path: of the table.
        problems: of another table, which take what is wrong with this one, too.

    Raises:
        DataError: no such file, another ending, or no table.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(
            f"{absent(path)}; expected a table, or arrays (*{', *'.join(ARRAY_SUFFIXES)})"
        )
    if not is_table(path):
        raise DataError(f"{path}: expected a table (csv, parquet, json, ...), no arrays")
    check_fetched(path)
    with path.open("rb") as file:
        first = b"".join(file.read(PEEKED).removeprefix(codecs.BOM_UTF8).split())
    kind = next((kind for start, kind in STARTS.items() if first.startswith(start)), None)
    kind = "Parquet" if path.suffix.lower() == ".parquet" else kind
    if kind == RECORDS:
        check_bytes(path, path.stat().st_size, most_text())
    sheet = unfold_cells(read_text(path) if kind is None else read_frame(path, kind))
    return replace(sheet, problems=Problems(path) if problems is None else problems)

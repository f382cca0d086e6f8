"""A table as it was written: heads, cells and what people call the rows; nothing is interpreted here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from gsparc.data.errors import DataError, Problems

# What stands for no value, in small letters.
MISSING = ("", "-", "--", "---", "n/a", "na", "nan", "#n/a", "null", "none", "nil", "?", ".")
DECIMAL_COMMA = r"\s*[-+]?\d*,\d+(?:[eE][-+]?\d+)?\s*"
DECIMAL_POINT = r"\s*[-+]?\d*\.\d+(?:[eE][-+]?\d+)?\s*"


@dataclass(frozen=True)
class Sheet:
    """A rectangular table.

    Attributes:
        source: the file, for messages.
        heads: one for each column, all different where they are not empty.
        columns: as many Series, of text or of numbers.
        rows: what a message calls each row: `line 2`, `row 0`.
        decimal: `.` or `,`, of numbers that are text.
    """

    source: str
    heads: tuple[str, ...]
    columns: tuple[pd.Series, ...]
    rows: tuple[str, ...]
    decimal: str = "."

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, head: str) -> str:
        """How messages name a column."""
        return f"{self.source}, column {head!r}"

    def words(self, head: str) -> np.ndarray:
        """Text (S,) of a column, without surrounding spaces; empty where there is no value."""
        column = self.columns[self.heads.index(head)]
        missing = column.isna().to_numpy()
        if pd.api.types.is_float_dtype(column.dtype) and (column[~missing] % 1 == 0).all():
            column = column.astype("Int64")  # 212, not 212.0: a name that was read as a number
        text = column.astype(str).str.strip().to_numpy(dtype=object)
        empty = missing | np.isin(np.char.lower(text.astype(str)), MISSING)
        return np.where(empty, "", text).astype(str)

    def numbers(self, head: str, problems: Problems) -> np.ndarray | None:
        """Numbers (S,) float64 of a column, NaN for no value; None, and noted, where a cell is text."""
        column = self.columns[self.heads.index(head)]
        if pd.api.types.is_bool_dtype(column.dtype):
            return problems.add(self.where(head), "holds True and False; expected numbers")
        if pd.api.types.is_numeric_dtype(column.dtype):
            values = column.to_numpy(dtype=np.float64, na_value=np.nan)
            bad = np.isinf(values)
        else:
            cells = [str(cell) for cell in column]
            if self.decimal == ",":
                # A point in such a file is a second sort of mark, or stands between thousands: refused.
                cells = ["x" if "." in cell else cell.replace(",", ".") for cell in cells]
            values = pd.to_numeric(np.array(cells, dtype=object), errors="coerce").astype(np.float64)
            bad = ~np.isfinite(values)
            if bad.any():
                bad[bad] = self.words(head)[bad] != ""
        if bad.any():
            shown = column.astype(str).to_numpy(dtype=object)
            rows = (f"{self.rows[i]}: {_shown(shown[i])}" for i in np.flatnonzero(bad))
            mark = (
                "decimal commas" if self.decimal == "," else "decimal points, and no marks between thousands"
            )
            marks = f"; this table has {mark}" if any("," in c or "." in c for c in shown[bad]) else ""
            return problems.add_rows(self.where(head), rows, f"is no finite number{marks}; or leave it empty")
        return values


def _shown(cell: str) -> str:
    return repr(cell if len(cell) <= 40 else cell[:37] + "...")


def read_parquet(source: str) -> Sheet:
    """The columns of a Parquet file.

    Raises:
        DataError: pyarrow is missing, or the file is damaged.
    """
    try:
        from pyarrow import ArrowException
        from pyarrow.parquet import read_table
    except ImportError:
        raise DataError(f"{source}: Parquet needs pyarrow; say: pip install 'gsparc[tables]'") from None
    try:
        frame = read_table(source).to_pandas()
    except (ArrowException, OSError, ValueError) as error:
        raise DataError(f"{source}: damaged or not a Parquet file ({str(error).splitlines()[0]})") from None
    unnamed = [i for i, name in enumerate(frame.index.names) if name is None]
    frame = frame.reset_index(level=unnamed, drop=True) if unnamed else frame
    if frame.index.names[0] is not None:  # pandas sets some columns aside as an index: columns all the same
        frame = frame.reset_index(allow_duplicates=True)
    heads = tuple(str(name) for name in frame.columns)
    twice = [name for name in heads if heads.count(name) > 1]
    if twice:
        raise DataError(f"{source}: two columns are named {twice[0]!r}; rename one")
    if not len(frame):
        raise DataError(f"{source}: no rows")
    rows = tuple(f"row {i}" for i in range(len(frame)))
    return Sheet(source, heads, tuple(frame.iloc[:, i] for i in range(len(heads))), rows)

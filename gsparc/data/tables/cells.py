"""Levels in Parquet that do not fit into memory: rows become means by cells of places while they are read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.data.errors import DataError
from gsparc.data.limits import POSITIVE
from gsparc.data.tables.columns import Chosen, Column
from gsparc.data.tables.heads import AXES, KINDS
from gsparc.data.tables.opening import open_parquet
from gsparc.data.tables.sheet import Sheet

LOOKED_AT = 10_000  # rows by which columns are understood
METRES = 111_320.0  # of a degree of latitude
ENDS = ("", "rx_", "tx_")
CHUNK = {"batch_readahead": 2, "fragment_readahead": 1}  # of 131,072 rows and of files: memory


def merge_cells(first: Sheet, chosen: Chosen, cell_m: float) -> Sheet:
    """Merge rows by cell of places and values of other columns: means of levels [dB] and coordinates.

    Rows without a level are apart from those with one, as they were not heard. Memory grows with cells, not
    with rows; the order is that of the first rows.

    Args:
        first: rows by which columns were chosen.
        chosen: the columns.
        cell_m: side of the cells [m].

    Raises:
        SettingError: a side that is not positive.
        DataError: no column of levels in decibels, text where numbers are needed, damaged files.
    """
    POSITIVE.check("dataset.cell_m", cell_m)
    if "rssi_db" not in chosen:
        raise DataError(f"{first.source}: dataset.cell_m merges levels; say dataset.columns.rssi_db=COLUMN")
    with open_parquet(first.source) as files:
        from pyarrow import acero, compute

        wanted = {c.head: c for columns in chosen.values() for c in columns if c.head is not None}
        keys, values, sums = [], {}, []
        for number, (head, column) in enumerate(wanted.items()):
            value, key = compute.field(head), f"key {number}"
            if column.role == "rssi_db" or column.role in {end + axis for end in ENDS for axis in AXES}:
                value = value.cast("float64")
                values[head] = value
                sums += [(head, f"hash_{how}", None, f"{how} {number}") for how in ("mean", "min", "max")]
                absent = compute.is_null(value, nan_is_null=True)
                cell = compute.floor(value * (_metres(column, chosen, first) / cell_m))
                value = absent if column.role == "rssi_db" else cell + 0.0  # of -0.0 and 0.0 one
            values[key] = value
            keys.append(key)
        scan = acero.ScanNodeOptions(files, columns=list(wanted), require_sequenced_output=True, **CHUNK)
        project = acero.ProjectNodeOptions(list(values.values()), list(values))
        steps = {"scan": scan, "project": project, "aggregate": acero.AggregateNodeOptions(sums, keys)}
        plan = acero.Declaration.from_sequence([acero.Declaration(*step) for step in steps.items()])
        frame = plan.to_table(use_threads=False).to_pandas()  # one thread adds in one order
    for number, head in enumerate(wanted):
        if head in values:  # a mean of equal numbers is that number, but for rounding
            least, most = frame[f"min {number}"], frame[f"max {number}"]
            frame[f"key {number}"] = frame[f"mean {number}"].clip(least, most)
    rows = tuple(f"cell {i}" for i in range(len(frame)))
    return replace(first, frame=frame[keys].set_axis([*wanted], axis=1), rows=rows)


def _metres(column: Column, chosen: Chosen, first: Sheet) -> float:
    """Of a step of 1 in a column of coordinates [m]."""
    factor = 1.0 if column.unit is None else column.unit.factor
    if KINDS[column.role] != "angle":
        return factor
    if not column.role.endswith("longitude"):
        return factor * METRES
    latitude = chosen[column.role.replace("longitude", "latitude")][0].numbers(first)
    return factor * METRES * float(np.cos(np.radians(0.0 if latitude is None else np.nanmean(latitude))))

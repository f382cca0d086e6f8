"""A station whose level steps counts as another one from there on: another gain, antenna or cable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.errors import DataError
from gsparc.data.fields import MEASUREMENTS
from gsparc.data.raw import Raw
from gsparc.data.selection import (
    FROM_ROW,
    known_station,
    measured_links,
    parts_of,
    per_station,
    refuse_columns,
    row_count,
    station_count,
)


def rows_by_station(given: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """The setting `dataset.level_steps`, checked.

    Raises:
        DataError: what it holds is not lists of rows.
    """
    found = {}
    for station, firsts in given.items():
        rows = (firsts,) if isinstance(firsts, int) else firsts
        good = isinstance(rows, Sequence) and not isinstance(rows, str) and len(rows) > 0
        if not good or not all(type(row) is int for row in rows):
            raise DataError(
                f"dataset.level_steps.{station}={firsts}: expected first rows after steps, like [1162]"
            )
        found[str(station)] = tuple(rows)
    return found


def split_stations(raw: Raw, steps: Mapping[str, Sequence[int]], source: str | Path) -> Raw:
    """Each station of `steps` becomes several of the same place and kind, `NAME`, `NAME from row 1162`, ...

    Args:
        raw: arrays of a file, named as in docs/own-data.md.
        steps: by name or number of a station, the first rows (from 0) after each step.
        source: for messages.

    Raises:
        DataError: no such station or row, or the file has no stations.
    """
    for station, firsts in steps.items():
        for first in sorted(firsts):
            raw = _split(raw, station, first, source)
    return raw


def _split(raw: Raw, station: str, first: int, source: str | Path) -> Raw:
    count, rows = station_count(raw), row_count(raw, source)
    said = f"dataset.level_steps.{station}={first}"
    if count is None:
        raise DataError(f"{said}: {source} has no stations; expected station_position")
    if not 0 < first < rows:
        raise DataError(f"{said}: expected a row between 1 and {rows - 1}, of rows 0 to {rows - 1}")
    names = [str(name) for name in raw.arrays.get("station_name", np.arange(count)).ravel()]
    number = known_station(station, names, count, said, source)
    last = parts_of(number, names)[-1]  # later steps divide the part after earlier ones
    arrays = {
        name: np.concatenate([array, array[number : number + 1]])
        if per_station(name, array, count)
        else array
        for name, array in raw.arrays.items()
    }
    arrays["station_name"] = np.array([*names, f"{names[number]}{FROM_ROW}{first}"])
    after = np.arange(rows) >= first
    if "station" in arrays:
        of_row = arrays["station"]
        arrays["station"] = np.where((of_row == last) & after, count, of_row)
        return replace(raw, arrays=arrays)
    measured = measured_links(raw, source)
    for name in (*MEASUREMENTS, "mask"):
        if name in arrays:
            refuse_columns(arrays[name], name, count, source)
    here = measured[:, last : last + 1] & after.reshape(-1, *[1] * (measured.ndim - 1))
    mask = np.concatenate([measured, here], axis=1)
    mask[:, last] &= ~after.reshape(-1, *[1] * (measured.ndim - 2))
    for name in MEASUREMENTS:
        if name in arrays:
            arrays[name] = np.concatenate([arrays[name], arrays[name][:, last : last + 1]], axis=1)
    return replace(raw, arrays={**arrays, "mask": mask})

"""Arrays of a file before they are measurements; `raw.py` reads and writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

HDF5_SUFFIXES = (".h5", ".hdf5")
NETCDF_SUFFIXES = (".nc", ".nc3", ".nc4", ".cdf")
ARRAY_SUFFIXES = (".npz", ".mat", *HDF5_SUFFIXES, *NETCDF_SUFFIXES)


@dataclass(frozen=True)
class Raw:
    """What a file holds.

    Attributes:
        arrays: by name.
        attributes: numbers and strings about the whole file.
        units: unit of an array where the file gives one.
        notes: how it was understood and what of it was left out, for the user, one line each.
        explain: what there is to say of the measurements that these became, and (S,) the row of
            each, from 0.
        said: of a table, its columns by quantity, as `dataset.columns` and answers say.
        roles: of a table's columns (`gsparc.tables.sheet`).
        heads: of a table.
    """

    arrays: dict[str, np.ndarray]
    attributes: dict[str, Any] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    explain: Callable[[Any, np.ndarray], list[str]] = lambda data, file_row: []
    said: Mapping[str, object] = field(default_factory=dict)
    roles: tuple[Any, ...] = ()
    heads: tuple[str, ...] = ()


def name_rows_by_number(count: int) -> np.ndarray:
    """Return what rows (count,) are called that their file does not name."""
    return np.array([f"row {i}" for i in range(count)])


def rename_arrays(raw: Raw, names: Mapping[str, str]) -> Raw:
    """Return the same content with arrays and their units renamed from the keys
    to the values of `names`.
    """
    arrays = {names.get(k, k): v for k, v in raw.arrays.items()}
    return replace(raw, arrays=arrays, units={names.get(k, k): v for k, v in raw.units.items()})

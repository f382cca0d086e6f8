"""Variables of a NetCDF file as named arrays: classic files (NetCDF3) by SciPy, NetCDF4 by h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.io import netcdf_file

from gsparc.data.errors import DataError
from gsparc.data.hdf5_probe import read_error
from gsparc.data.raw import DAMAGED, Raw

SUFFIXES = (".nc", ".nc3", ".nc4", ".cdf")
NEVER_WRITTEN = 9e36  # default fill value of NetCDF's floating point numbers is 9.97e36


def read_netcdf(path: str | Path) -> Raw:
    """Every variable of the root group; text as text, fill values of floating point numbers as NaN.

    Raises:
        DataError: no such file, another format, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected a NetCDF file")
    with path.open("rb") as file:
        start = file.read(4)
    if start == b"CDF\x05":
        raise DataError(f"{path}: NetCDF classic of 64-bit data is not read; convert with nccopy -k nc4")
    read = _classic if start[:3] == b"CDF" else _hdf5 if start == b"\x89HDF" else None
    if read is None:
        raise DataError(f"{path}: neither NetCDF3 nor NetCDF4; its first bytes are {start!r}")
    try:
        arrays = {name: _plain(*variable) for name, variable in read(path).items()}
    except DataError:
        raise
    except (*DAMAGED, AssertionError, IndexError, AttributeError) as error:  # what SciPy raises on damage
        why = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: damaged or not a NetCDF file ({why})") from None
    return Raw(arrays)


def _classic(path: Path) -> dict[str, tuple[np.ndarray, Any]]:
    with netcdf_file(str(path), "r", mmap=False) as file:
        return {
            name: (np.array(variable.data), getattr(variable, "_FillValue", None))
            for name, variable in file.variables.items()
        }


def _hdf5(path: Path) -> dict[str, tuple[np.ndarray, Any]]:
    reason = read_error(path)
    if reason is not None:
        raise DataError(f"{path}: damaged ({reason})")
    found: dict[str, tuple[np.ndarray, Any]] = {}
    with h5py.File(path, "r") as file:
        for name, item in file.items():
            if isinstance(item, h5py.Dataset):
                text = h5py.check_string_dtype(item.dtype)
                values = np.asarray(item.asstr()[()] if text and text.length is None else item[()])
                found[str(name)] = values, item.attrs.get("_FillValue")
    return found


def _plain(array: np.ndarray, fill: Any) -> np.ndarray:
    """Numbers in the machine's byte order, rows of characters joined to text."""
    if array.dtype == object:
        return array.astype(str)
    if array.dtype.kind == "S":
        if array.dtype.itemsize == 1 and array.ndim and array.shape[-1]:
            array = np.ascontiguousarray(array).view(f"S{array.shape[-1]}")[..., 0]
        return np.char.strip(np.char.decode(array, "utf-8", errors="replace"), "\0 ")
    array = array.astype(array.dtype.newbyteorder("="))
    if array.dtype.kind == "f":
        never = np.abs(array) > NEVER_WRITTEN
        if fill is not None:
            never |= array == np.asarray(fill).ravel()[0]
        array[never] = np.nan
    return array

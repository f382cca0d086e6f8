"""Named arrays with attributes and units, from and to npz and HDF5; nothing is interpreted here."""

from __future__ import annotations

import hashlib
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any

import h5py
import numpy as np
from numpy.lib.format import MAGIC_PREFIX
from numpy.lib.format import read_array_header_1_0 as header_1
from numpy.lib.format import read_array_header_2_0 as header_2
from scipy.io import loadmat, netcdf_file

from gsparc.base.archives import hdf5_text_error, is_archive
from gsparc.base.errors import DataError, absent, explain_error, readable
from gsparc.base.files import refuse_git_pointer, whole_file
from gsparc.data.blocks import is_big, iterate_bytes, map_from_disk
from gsparc.tables.array_sizes import Stated, check_array_sizes
from gsparc.tables.arrays import HDF5_SUFFIXES, NETCDF_SUFFIXES, Raw

UNREADABLE = (SyntaxError, TokenError)  # of a header that is no Python literal
COMPLEX = ("real imag", "re im", "r i")  # fields of compounds that MATLAB, Octave and others write
DIGEST = "content_sha256"  # attribute of HDF5 files that gsparc wrote
# What zipfile, zlib, numpy and h5py raise on damaged, truncated,
# encrypted or absurdly large content.
DAMAGED = (
    *(
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        OSError,
        EOFError,
        ValueError,
        TypeError,
        KeyError,
    ),
    TokenError,  # of a header that ends within a quotation, from Python 3.12 on
    *(RuntimeError, ArithmeticError, MemoryError),  # the first includes NotImplementedError
)


def read_raw(path: str | Path) -> Raw:
    """Read every array of an npz, HDF5, MATLAB or NetCDF file.

    Raises:
        DataError: no such file, another format, damaged, or Python objects inside.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{absent(path)}; expected *.npz, *.h5 or *.mat")
    readers = {".npz": _read_npz, ".mat": _read_mat}
    readers |= dict.fromkeys(HDF5_SUFFIXES, _read_hdf5) | dict.fromkeys(
        NETCDF_SUFFIXES, _read_netcdf
    )
    if path.suffix.lower() not in readers:
        suffix, endings = path.suffix or "no ending", ", ".join(readers)
        raise DataError(f"{path}: expected a name ending in one of {endings}; found {suffix}")
    refuse_git_pointer(path)
    return readers[path.suffix.lower()](path)


def write_raw(path: str | Path, raw: Raw) -> None:
    """Write `raw`, whole or not at all.

    Raises:
        DataError: another ending, or there is no room; what was there is kept.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", *HDF5_SUFFIXES):
        raise DataError(
            f"{path}: cannot be written as {path.suffix!r}; name it *.npz, *.h5 or *.hdf5"
        )
    write = _write_npz if path.suffix.lower() == ".npz" else _write_hdf5
    try:
        with whole_file(path) as partial:
            write(partial, raw)
    except (OSError, RuntimeError) as error:
        # libhdf5 makes the second of the first when it closes a file
        match = re.search(r"error message = '([^']+)'", str(error))
        why = match[1] if match else getattr(error, "strerror", None) or explain_error(error)
        raise DataError(f"{path}: cannot be written ({why}); what was there is kept") from error


def _write_npz(path: Path, raw: Raw) -> None:
    about = json.dumps({**raw.attributes, "units": raw.units}, ensure_ascii=False)
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, attributes=np.array(about), **raw.arrays)


def _write_hdf5(path: Path, raw: Raw) -> None:
    # Checksums and text of fixed length: libhdf5 crashes or hangs on damage that it cannot see.
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        for name, array in raw.arrays.items():
            data = np.char.encode(array, "utf-8") if array.dtype.kind == "U" else array
            if data.dtype.kind == "S":
                data = data.astype(h5py.string_dtype("utf-8", data.dtype.itemsize))
            stored = file.create_dataset(
                name, data=data, fletcher32=data.ndim > 0 and data.size > 0
            )
            if name in raw.units:
                stored.attrs["units"] = np.bytes_(raw.units[name], "utf-8")
        for name, value in raw.attributes.items():
            file.attrs[name] = np.bytes_(value, "utf-8") if isinstance(value, str) else value
        # HDF5 has no checksums of numbers and attributes.
        file.attrs[DIGEST] = np.bytes_(_digest(raw), "utf-8")


def _digest(raw: Raw) -> str:
    """SHA-256 of names, values, units and attributes, the same before writing and after reading."""
    digest = hashlib.sha256()
    for name, array in sorted(raw.arrays.items()):
        text = array.dtype.kind in "US"
        head = f"{name} {'text' if text else array.dtype.str} {array.shape} {raw.units.get(name)};"
        digest.update(head.encode())
        if text:
            digest.update("\0".join(array.ravel()).encode())
        else:
            for part in iterate_bytes(array):
                digest.update(part)
    for name, value in sorted(raw.attributes.items()):
        digest.update(f"{name}={np.asarray(_plain(value)).tolist()!r};".encode())
    return digest.hexdigest()


def _read_npz(path: Path) -> Raw:
    arrays: dict[str, np.ndarray] = {}
    name = "the archive"
    with readable(path, "cannot be read", OSError):
        if not is_archive(path):  # numpy would take anything else for a pickle and speak of that
            raise DataError(f"{path}: damaged or not an npz archive; save with numpy.savez")
    check_array_sizes(path, _stated_npz(path))
    try:
        with np.load(path, allow_pickle=False) as file:
            for name in file.files:
                if name in arrays:
                    raise KeyError("in the archive twice")
                arrays[name] = file[name]
    except DAMAGED as error:
        fault = f"damaged or not an npz file ({explain_error(error)})"
        if "allow_pickle" in str(error):
            fault = (
                "holds Python objects; expected plain arrays: numpy.savez(FILE, "
                "rx_position=..., csi=...)"
            )
        raise DataError(f"{path}, {name}: {fault}") from None
    # An npz has no attributes; ours keeps them as JSON text in an entry of that name.
    text = arrays.pop("attributes", None)
    if text is None:
        return Raw(arrays)
    errors = (ValueError, TypeError, RecursionError)
    with readable(f"{path}, attributes", "expected a JSON table as text", errors):
        attributes = json.loads(str(text))
        units = attributes.pop("units", {}) if isinstance(attributes, dict) else None
        if not isinstance(units, dict):
            raise TypeError(
                f"found a {type(attributes).__name__}" if units is None else "units is no table"
            )
    return Raw(arrays, attributes, {str(k): str(v) for k, v in units.items()})


def _stated_npz(path: Path) -> Stated:
    stated = {}
    # What is damaged is said where it is read
    with suppress(*DAMAGED), zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            with suppress(*DAMAGED, *UNREADABLE), archive.open(entry) as file:
                file.seek(len(MAGIC_PREFIX))
                shape, _, dtype = (header_1 if file.read(2)[0] == 1 else header_2)(file)
                stated[entry.filename.removesuffix(".npy")] = (
                    shape,
                    math.prod(shape) * dtype.itemsize,
                )
    return stated


@contextmanager
def _datasets(
    path: Path, to_disk: bool = False
) -> Iterator[tuple[h5py.File, dict[str, h5py.Dataset]]]:
    """An HDF5 file and its datasets by name, none larger than it can hold."""
    fault = hdf5_text_error(path)
    if fault is not None:
        raise DataError(f"{path}: damaged ({fault}); write it again, text best with a fixed length")
    with h5py.File(path, "r") as file:
        # h5py hands out bytes when a name is not UTF-8
        items = {
            str(_plain(name)): item for name, item in file.items() if isinstance(item, h5py.Dataset)
        }
        arrays = {name: item for name, item in items.items() if item.size is not None}
        # What lies in one piece takes nothing that is not in the file.
        stated = {
            name: (d.shape, 0 if d.id.get_offset() else d.nbytes) for name, d in arrays.items()
        }
        check_array_sizes(path, stated, to_disk)
        yield file, items


def _read_hdf5(path: Path) -> Raw:
    arrays, units, name = {}, {}, "the file"
    try:
        with _datasets(path, to_disk=True) as (file, items):
            for name, item in items.items():
                plain = not h5py.check_string_dtype(item.dtype) and not item.dtype.names
                arrays[name] = (
                    map_from_disk(item) if plain and is_big(item) else _values(item, fixed=True)
                )
                if "units" in item.attrs:
                    units[name] = _plain(item.attrs["units"])
                # Columns first, as all of MATLAB's
                if _plain(item.attrs.get("MATLAB_class")) == "char":
                    arrays[name] = np.array([*map(chr, arrays[name].T.ravel())])
            attributes = {_plain(key): _plain(value) for key, value in file.attrs.items()}
    except DataError:
        raise
    except DAMAGED as error:
        raise DataError(
            f"{path}, {name}: damaged or not an HDF5 file ({explain_error(error)})"
        ) from None
    arrays = {k: v.astype(str) if v.dtype == object else v for k, v in arrays.items()}
    written = attributes.pop(DIGEST, None)
    raw = Raw(arrays, attributes, units)
    if written is not None and written != _digest(raw):
        raise DataError(
            f"{path}: its content is not what was written; take a good copy, or, if you have "
            "changed it "
            f"yourself, delete the attribute {DIGEST}"
        )
    return raw


def _read_mat(path: Path) -> Raw:
    """Arrays of a MATLAB file without their axes of length 1, text as attributes."""
    if h5py.is_hdf5(path):  # version 7.3 writes HDF5, the axes of arrays in reverse
        arrays = {name: array.T for name, array in _read_hdf5(path).arrays.items()}
    else:
        with readable(path, "damaged or not a MATLAB file", (*DAMAGED, IndexError)):
            content = loadmat(path)
        arrays = {name: array for name, array in content.items() if not name.startswith("__")}
    words = {
        name: "".join(array.ravel()) for name, array in arrays.items() if array.dtype.kind == "U"
    }
    for name in [name for name, array in arrays.items() if array.dtype.kind in "OV"]:
        raise DataError(
            f"{path}, {name}: cells or structures; expected plain arrays: rx_position, csi, ..."
        )
    return Raw(
        {name: array.squeeze() for name, array in arrays.items() if name not in words}, words
    )


def _values(item: h5py.Dataset, fixed: bool = False) -> np.ndarray:
    """Values of a dataset; text of variable length, and `fixed` where wanted, as text,
    compounds complex.
    """
    text = h5py.check_string_dtype(item.dtype)
    if item.dtype.names and " ".join(item.dtype.names).lower() in COMPLEX:
        parts = item[()]
        return np.asarray(parts[item.dtype.names[0]] + 1j * parts[item.dtype.names[1]])
    return np.asarray(item.asstr()[()] if text and (fixed or text.length is None) else item[()])


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value.item() if isinstance(value, np.generic) else value


NEVER_WRITTEN = 9e36  # default fill value of NetCDF's floating point numbers is 9.97e36


def _read_netcdf(path: Path) -> Raw:
    """Every variable of the root group; text as text,
    fill values of floating point numbers as NaN.
    """
    with path.open("rb") as file:
        start = file.read(4)
    if start == b"CDF\x05":
        raise DataError(
            f"{path}: NetCDF classic of 64-bit data is not read; convert with nccopy -k nc4"
        )
    read = _classic if start[:3] == b"CDF" else _hdf5 if start == b"\x89HDF" else None
    if read is None:
        raise DataError(f"{path}: neither NetCDF3 nor NetCDF4; its first bytes are {start!r}")
    # The last three are what SciPy raises on damage.
    with readable(
        path, "damaged or not a NetCDF file", (*DAMAGED, AssertionError, IndexError, AttributeError)
    ):
        return Raw({name: _of_netcdf(*variable) for name, variable in read(path).items()})


def _classic(path: Path) -> dict[str, tuple[np.ndarray, Any]]:
    with netcdf_file(str(path), "r", mmap=False) as file:
        variables = file.variables.items()
        return {
            name: (np.array(variable.data), getattr(variable, "_FillValue", None))
            for name, variable in variables
        }


def _hdf5(path: Path) -> dict[str, tuple[np.ndarray, Any]]:
    with _datasets(path) as (_, items):
        return {name: (_values(item), item.attrs.get("_FillValue")) for name, item in items.items()}


def _of_netcdf(array: np.ndarray, fill: Any) -> np.ndarray:
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

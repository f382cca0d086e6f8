"""Read pickles of arrays and tables without running what else a pickle may carry."""

from __future__ import annotations

import codecs
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy._core import multiarray
from numpy.lib.format import MAGIC_LEN

from gsparc.base.errors import readable


class Placeholder:
    """Stands in for an object of a class that is not imported.

    Attributes:
        made_with, named: arguments it was made with.
        state: what it was given then.
    """

    def __new__(cls, *made_with: Any, **named: Any) -> Placeholder:
        """Keep the arguments."""
        stored = super().__new__(cls)
        stored.made_with, stored.named, stored.state = made_with, named, None
        return stored

    def __setstate__(self, state: Any) -> None:
        self.state = state

    made_with: tuple[Any, ...]
    named: dict[str, Any]
    state: Any


class FromBuffer(Placeholder):
    """Makes the array that bytes hold, as NumPy's function of that name;
    a pickle cannot alter it.
    """

    def __new__(cls, buffer: Any, dtype: Any, shape: Any, order: Any, *_: Any) -> Any:
        """Return the array."""
        return np.frombuffer(buffer, dtype).reshape(shape, order=order)


# By name below numpy, builtins or _codecs: these build arrays, and no more.
ARRAYS: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    "numpy.multiarray._reconstruct": multiarray._reconstruct,  # type: ignore[attr-defined]
    "numpy.multiarray.scalar": multiarray.scalar,  # type: ignore[attr-defined]
    "numpy.numeric._frombuffer": FromBuffer,
    "builtins.slice": slice,
    "_codecs.encode": codecs.encode,
}
FRAMES = {  # of pandas 1 to 3
    "pandas.core.frame.DataFrame",
    "pandas.core.internals.managers.BlockManager",
    "pandas._libs.internals._unpickle_block",
    "pandas.core.indexes.base._new_Index",
    "pandas.core.indexes.base.Index",
    "pandas.core.indexes.numeric.Int64Index",
    "pandas.core.indexes.range.RangeIndex",
    "pandas.DataFrame",
    "pandas.Index",
    "pandas.RangeIndex",
}


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: BinaryIO, stand_ins: set[str]) -> None:
        super().__init__(file)
        self.stand_ins = stand_ins

    def find_class(self, module: str, name: str) -> Any:
        """Return what builds an array, or the stand-in; nothing else is imported."""
        plain = module.replace("numpy._core", "numpy").replace("numpy.core", "numpy")
        if f"{plain}.{name}" in ARRAYS:
            return ARRAYS[f"{plain}.{name}"]
        if f"{module}.{name}" in self.stand_ins:
            return Placeholder
        fault = (
            f"asks for {module}.{name}, which is neither an array nor a part of a table: not run"
        )
        raise pickle.UnpicklingError(fault)


def read_pickle(path: Path, stand_ins: set[str], npy: bool = False) -> Any:
    """Read what a pickle holds, of arrays, plain values and `Placeholder`.

    Args:
        path: of the file.
        stand_ins: full names of classes and functions that `Placeholder` stands in for.
        npy: whether it lies behind the header of a npy file, as `numpy.save` writes objects.

    Raises:
        DataError: missing, damaged, or it names something else.
    """
    # A damaged pickle makes its parts raise anything.
    with (
        readable(path, "damaged, or no pickle of arrays", Exception, "no such file"),
        path.open("rb") as file,
    ):
        if npy:
            version = file.read(MAGIC_LEN)[-2]
            file.read(int.from_bytes(file.read(2 if version == 1 else 4), "little"))
        return _Unpickler(file, stand_ins).load()


def read_pickled_frame(path: Path) -> dict[str, np.ndarray]:
    """Read columns (rows,) of a pickled pandas table by their names, whatever pandas is installed.

    Raises:
        DataError: as `read_pickle`, or it is no table.
    """
    frame = read_pickle(path, FRAMES)
    errors = (AttributeError, KeyError, TypeError, ValueError, IndexError)
    with readable(path, "no pickled pandas table", errors):
        blocks, (heads, _) = frame.state["_mgr"].made_with[:2]
        names = heads.made_with[1]["data"]
        columns: dict[str, np.ndarray] = {}
        for values, place, *_ in (block.made_with for block in blocks):
            columns |= dict(zip(names[place], np.asarray(values), strict=True))
    return columns

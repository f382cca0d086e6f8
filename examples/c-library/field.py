"""An exported field by ctypes:
`Field("FOLDER/field.gsparc", "FOLDER/build/libgsparc_field.so")`.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np

SPECTRUM, CHANNEL, POWER = 1, 2, 3
LINE = 64  # bytes that scratch memory starts on a multiple of


class Facts(ctypes.Structure):
    """`gsparc_facts` of gsparc_field.h."""

    _fields_ = (
        ("kind", ctypes.c_int32),
        ("axes", ctypes.c_int32),
        ("shape", ctypes.c_int32 * 2),
        ("values", ctypes.c_int64),
        ("scratch", ctypes.c_int64),
        ("origin", ctypes.c_double * 3),
        ("error", ctypes.c_double),
        ("worst", ctypes.c_double),
    )


class Field:
    """Answers at world places [m]; one thread at a time, as its memory is its own."""

    def __init__(self, path: str | Path, library: str | Path) -> None:
        self._c = ctypes.CDLL(str(library))
        # Pointers must be said to be pointers: an int, ctypes' default,
        # cuts off their upper 32 bits.
        self._c.gsparc_load.restype = self._c.gsparc_free.restype = ctypes.c_void_p
        self._c.gsparc_about.restype = Facts
        for call, count in (("about", 1), ("free", 1), ("query", 6)):
            getattr(self._c, f"gsparc_{call}").argtypes = [ctypes.c_void_p] * count
        why = ctypes.create_string_buffer(200)
        self._field = self._c.gsparc_load(str(path).encode(), why, len(why))
        if not self._field:
            raise ValueError(f"{path}: {why.value.decode()}")
        self.facts = self._c.gsparc_about(self._field)
        # NumPy aligns to 16 bytes: a line more, of which the first multiple of 64 is taken.
        self._memory = np.empty(self.facts.scratch + LINE, np.uint8)
        self._scratch = -(-self._memory.ctypes.data // LINE) * LINE

    def __call__(self, place: np.ndarray) -> tuple[np.ndarray, float, float]:
        """The answer at (3,) [m], or (6,) of both ends; its variance,
        and the share that is unknown.
        """
        facts = self.facts
        # In float64, since float32 of UTM metres moves in steps of half a metre.
        local = np.asarray(place, np.float64) - np.tile(facts.origin[:], facts.axes // 3)
        at, values, doubt = (
            local.astype(np.float32),
            np.empty(facts.values, np.float32),
            np.empty(2, np.float32),
        )
        where = doubt.ctypes.data
        status = self._c.gsparc_query(
            self._field, at.ctypes.data, values.ctypes.data, where, where + 4, self._scratch
        )
        if status:
            raise ValueError(f"query at {place}: status {status}")
        values = values.view(np.complex64) if facts.kind == CHANNEL else values
        return values.reshape(facts.shape[:]), float(doubt[0]), float(doubt[1])

    def close(self) -> None:
        """Give the field's memory back."""
        self._c.gsparc_free(self._field)

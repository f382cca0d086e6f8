"""A compiled field's file: named arrays, a version and a checksum;
read by `ops/csrc/field/blob.cpp`.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

import numpy as np

from gsparc.prediction.predictor import Predictor

# \r\n as in PNG: a transfer as text would change it, which is then found out. 64: a cache line.
MAGIC, VERSION, LINE = b"GSPARC\r\n", 4, 64
TYPES = {np.dtype(t): i for i, t in enumerate((np.float32, np.float64, np.int32, np.int64))}
HEAD, SECTION = struct.Struct("<8sIIqq"), struct.Struct("<24sIIqq")
CHECKED = 16  # bytes before those that the checksum is of


@dataclass(frozen=True)
class Form:
    """One of the forms that are compiled.

    Attributes:
        kind: 1 an array's spectrum, 2 a frozen image, 3 sources, 4 a process of powers, 5 a mean of
            such.
        numbers: sizes and parameters, in the order in which the form's constructor reads them.
        arrays: by name, contiguous, of a type in `TYPES`.
        predictor: answers as the form does, for its error; None: the model itself does.
        variance_lost: share of the mean variance at rows that variances are too large by.
    """

    kind: int
    numbers: list[float]
    arrays: dict[str, np.ndarray] = field(repr=False)
    predictor: Predictor | None = None
    variance_lost: float = 0.0


def pack_form(form: Form, origin: np.ndarray, error: float = 0.0, worst: float = 0.0) -> bytes:
    """Return the file's bytes; places are from `origin` (3,) [m],
    errors are those of `CompiledForm`.
    """
    numbers = np.array([form.kind, error, worst, *origin, *form.numbers], np.float64)
    arrays = {
        "numbers": numbers,
        **{name: value for name, value in form.arrays.items() if value.size},
    }
    at = HEAD.size + SECTION.size * len(arrays)
    table, body = [], []
    for name, value in arrays.items():
        # Sections begin at cache lines: C reads vectors from the file as it is mapped.
        gap = -at % LINE
        body += [bytes(gap), np.ascontiguousarray(value).tobytes()]
        table.append(SECTION.pack(name.encode(), TYPES[value.dtype], 0, at + gap, value.size))
        at += gap + value.nbytes
    checked = struct.pack("<qq", at, len(arrays)) + b"".join([*table, *body])
    # The sum covers sizes and all arrays, but not itself and what comes before it.
    return HEAD.pack(MAGIC, VERSION, zlib.crc32(checked), at, len(arrays))[:CHECKED] + checked

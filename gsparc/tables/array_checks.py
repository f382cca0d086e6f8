"""Arrays of a file by name: what they hold, of which shape, with what is wrong noted by row."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gsparc.base.errors import Problems
from gsparc.data.fields import FIELDS, HOLDS, POWER
from gsparc.tables.arrays import Raw

Shape = tuple[int | str | None, ...]


def _fits(sizes: tuple[int, ...], shape: Shape) -> bool:
    return len(sizes) == len(shape) and all(
        want in (None, n) for want, n in zip(shape, sizes, strict=True)
    )


class ArrayChecker:
    """Takes arrays out of a `Raw`, noting what is wrong;
    a method returns None when its array is unusable.
    """

    def __init__(self, raw: Raw, source: str) -> None:
        # HDF5 holds attributes that are arrays: lists can be compared with words.
        plain = {
            k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in raw.attributes.items()
        }
        self.raw, self.source = replace(raw, attributes=plain), source
        self.problems = Problems(source)
        self.notes, self.given = [*raw.notes], raw.arrays
        self.row_names: list[str] = []
        self.unknown: str | None = None  # a position that nobody gave
        self.sizes: dict[str, int] = {}  # of axes by their letter

    def describe_array(self, name: str) -> str:
        """Say how messages name an array of this file."""
        return f"{self.source}, {name}"

    def refuse(self, name: str, what: str) -> Any:
        """Note what is wrong with an array; returns None, so that a check can end with it."""
        self.problems.add(self.describe_array(name), what)

    def refuse_rows(self, name: str, bad: np.ndarray, what: str) -> bool:
        """Note `what` for the rows of an array where `bad` (S, ...) has a True;
        returns whether one does.
        """
        rows = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
        self.problems.add_rows(self.describe_array(name), (self.row_names[i] for i in rows), what)
        return len(rows) > 0

    def present(self, *names: str) -> list[str]:
        """Return those of `names` that the file holds."""
        return [name for name in names if name in self.raw.arrays]

    def read_array(self, name: str, *shapes: Shape, holds: str = "") -> np.ndarray | None:
        """Return array `name` if it `holds` what it should and fits one
        of `shapes` (None: any length).
        """
        array, holds = self.raw.arrays.get(name), holds or FIELDS[name].holds
        if array is None:
            return None
        # Images of uint16 hold no stated largest value; of uint8 it is 255.
        wide = holds == POWER and array.dtype.kind == "u" and array.itemsize > 1
        if array.dtype.kind not in HOLDS[holds] or wide:
            return self.refuse(name, f"expected {holds}, found dtype {array.dtype}")
        return array if self.has_shape(name, array, *shapes) else None

    def read_real(self, name: str, *shapes: Shape) -> np.ndarray | None:
        """Return the same as float64."""
        array = self.read_array(name, *shapes)
        return None if array is None else array.astype(np.float64)

    def has_shape(self, name: str, array: np.ndarray, *shapes: Shape) -> bool:
        """Tell whether `array` has one of `shapes`, letters for sizes found before;
        note it when not.
        """
        wanted = [
            tuple(self.sizes.get(a) if isinstance(a, str) else a for a in shape) for shape in shapes
        ]
        if not wanted or any(_fits(array.shape, shape) for shape in wanted):
            return True
        # Samples come first: an array of three rows is mostly (3, S) instead of (S, 3).
        turned = array.ndim > 1 and (
            len(array) == 3 or any(_fits(array.shape[::-1], s) for s in wanted)
        )
        sizes = " or ".join(map(str, wanted))
        sizes = f", here {sizes}" if any(wanted) and "None" not in sizes else ""
        layout = (
            FIELDS[name].shape if name in FIELDS else " or ".join(map(str, shapes)).replace("'", "")
        )
        fault = f"found {array.shape}{'; transposed?' if turned else ''}"
        self.refuse(name, f"expected shape {layout}{sizes}, {fault}")
        return False

"""What is wrong with a file of one's own: each check notes problems with array, row and expectation."""

from __future__ import annotations

import difflib
import math

import numpy as np

from gsparc.data.assemble import check_positions
from gsparc.data.errors import Problems
from gsparc.data.fields import FIELDS, MEASUREMENTS
from gsparc.data.raw import Raw
from gsparc.data.rotation import is_rotation, quaternion_to_matrix
from gsparc.ops import SphereGrid

LOWEST_HZ, HIGHEST_HZ = 1e5, 1e13


class Checker:
    """Takes arrays out of a `Raw`, noting what is wrong; a method returns None when its array is unusable."""

    def __init__(self, raw: Raw, source: str) -> None:
        self.raw, self.source = raw, source
        self.problems = Problems(source)
        self.notes: list[str] = []

    def where(self, name: str) -> str:
        """How messages name an array of this file."""
        return f"{self.source}, {name}"

    def names(self) -> None:
        """Misspelt names are refused, other unknown ones are noted as ignored; units must be the schema's."""
        for name in self.raw.arrays:
            if name in FIELDS:
                continue
            close = [n for n in difflib.get_close_matches(name, FIELDS, n=3) if n not in self.raw.arrays]
            if close:
                self.problems.add(self.where(name), f"unknown name; did you mean {close[0]}?")
            else:
                self.notes.append(f"{name}: not part of the schema, ignored")
        for name, unit in self.raw.units.items():
            if name in FIELDS and name in self.raw.arrays and unit != FIELDS[name].unit:
                self.problems.add(self.where(name), f"units are {unit!r}; expected {FIELDS[name].unit!r}")

    def measurement(self) -> str | None:
        """Which of spectrum, csi, rssi, rssi_db to read: the only one, or the one that an attribute names."""
        present = [name for name in MEASUREMENTS if name in self.raw.arrays]
        if len(present) == 1:
            return present[0]
        named = self.raw.attributes.get("measurement")
        if named in present:
            return str(named)
        found = " and ".join(present) if present else "none of them"
        self.problems.add(self.source, f"expected exactly one of {', '.join(MEASUREMENTS)}; found {found}")
        return None

    def real(self, name: str, *shapes: tuple[int | None, ...]) -> np.ndarray | None:
        """Array `name` as float64 when it is real and fits one of `shapes` (None: any length)."""
        array = self.raw.arrays.get(name)
        if array is None:
            return None
        if array.dtype.kind not in "iuf":
            self.problems.add(self.where(name), f"expected real numbers, found dtype {array.dtype}")
            return None
        return array.astype(np.float64) if self.fits(name, array, *shapes) else None

    def fits(self, name: str, array: np.ndarray, *shapes: tuple[int | None, ...]) -> bool:
        """Whether `array` has one of `shapes`; notes it when not."""
        for shape in shapes:
            if array.ndim == len(shape) and all(
                want is None or want == got for want, got in zip(shape, array.shape, strict=True)
            ):
                return True
        hint = (
            "; transposed?" if any(array.shape[::-1] == s for s in shapes) or array.shape[:1] == (3,) else ""
        )
        expected = FIELDS[name].shape
        constrained = any(count is not None for shape in shapes for count in shape)
        here = f", here {' or '.join(str(s).replace('None', 'any') for s in shapes)}" if constrained else ""
        self.problems.add(self.where(name), f"expected shape {expected}{here}, found {array.shape}{hint}")
        return False

    def position(self, name: str, rows: int | None, row_names: list[str]) -> np.ndarray | None:
        """(S, 3) or (3,) float64 [m]."""
        if name not in self.raw.arrays:
            self.problems.add(
                self.where(name), f"missing; expected {FIELDS[name].shape} [{FIELDS[name].unit}]"
            )
            return None
        array = self.real(name, (3,), (rows, 3))
        if array is None:
            return None
        names = (row_names or [f"row {i}" for i in range(len(array))]) if array.ndim == 2 else ["its value"]
        before = len(self.problems)
        check_positions(self.problems, self.where(name), np.atleast_2d(array), names)
        if len(self.problems) > before:
            return None
        stored = self.raw.arrays[name]
        if stored.dtype.kind == "f" and stored.dtype.itemsize <= 4:
            step = float(np.spacing(np.abs(stored).max()))
            if step > 1e-3:
                self.notes.append(
                    f"{name}: stored as {stored.dtype} this far from the origin, it moves in steps of "
                    f"{step * 1e3:.1f} mm; store float64"
                )
        return array

    def finite(self, name: str, values: np.ndarray, mask: np.ndarray | None, row_names: list[str]) -> None:
        """Every measured entry of `values` (S, ...) must be finite."""
        bad = ~np.isfinite(values)
        if mask is not None:
            bad &= mask
        rows = np.flatnonzero(bad.reshape(len(values), -1).any(axis=1))
        self.problems.add_rows(
            self.where(name),
            (row_names[i] for i in rows),
            "not finite; expected numbers (mark what was not measured in mask)",
        )

    def mask(self, shape: tuple[int, ...], row_names: list[str]) -> np.ndarray | None:
        """Bool, like the measurement; None when everything was measured."""
        array = self.raw.arrays.get("mask")
        if array is None or not self.fits("mask", array, shape):
            return None
        if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
            self.problems.add(self.where("mask"), f"expected True and False, found dtype {array.dtype}")
            return None
        mask = array.astype(bool)
        empty = np.flatnonzero(~mask.reshape(len(mask), -1).any(axis=1))
        self.problems.add_rows(
            self.where("mask"),
            (row_names[i] for i in empty),
            "nothing measured; expected a True, or drop the row",
        )
        return mask

    def frequencies(self, count: int | None) -> tuple[np.ndarray | None, float | None]:
        """(K,) [Hz] or None, and the carrier [Hz] or None; csi needs `count` of them (None without csi)."""
        frequency = self.real("frequency_hz", (), (None,) if count is None else (count,))
        if count is not None and "frequency_hz" not in self.raw.arrays:
            self.problems.add(self.where("frequency_hz"), f"missing; csi needs the {count} frequencies [Hz]")
        carrier = self.real("carrier_hz", ())
        for name, values in (("frequency_hz", frequency), ("carrier_hz", carrier)):
            if values is None:
                continue
            if values.size == 0 or not np.all((values >= LOWEST_HZ) & (values <= HIGHEST_HZ)):
                self.problems.add(
                    self.where(name),
                    f"{np.array2string(values, threshold=4)} is outside {LOWEST_HZ:.0e} to {HIGHEST_HZ:.0e}; "
                    "expected Hz (not MHz or GHz)",
                )
                return None, None
            if len(np.unique(values)) != values.size:
                self.problems.add(self.where(name), "the same frequency twice; expected distinct ones [Hz]")
        if frequency is not None and frequency.ndim == 0 and count not in (None, 1):
            self.problems.add(
                self.where("frequency_hz"),
                f"one frequency, but csi has {count} columns; expected {count} frequencies, "
                "or csi of shape (S, A, 1) when its columns are antennas",
            )
            return None, None
        if frequency is None:
            return None, None if carrier is None else float(carrier)
        frequency = np.atleast_1d(frequency)
        return frequency, float(frequency.mean() if carrier is None else carrier)

    def rotation(self, rows: int, row_names: list[str]) -> np.ndarray | None:
        """(S, 3, 3) local to world; the identity when the file says nothing."""
        given = [name for name in ("rx_orientation", "rx_rotation") if name in self.raw.arrays]
        if len(given) == 2:
            self.problems.add(
                self.source, "rx_orientation and rx_rotation are both given; expected one of them"
            )
            return None
        if not given:
            return np.broadcast_to(np.eye(3), (rows, 3, 3)).copy()
        name = given[0]
        if name == "rx_rotation":
            matrix = self.real(name, (3, 3), (rows, 3, 3))
            if matrix is None:
                return None
            matrix = np.broadcast_to(matrix, (rows, 3, 3)).copy()
            bad = np.flatnonzero(~is_rotation(matrix))
            expected = "not a rotation; expected an orthogonal matrix with determinant +1, receiver to world"
            self.problems.add_rows(self.where(name), (row_names[i] for i in bad), expected)
            return None if len(bad) else matrix
        quaternion = self.real(name, (4,), (rows, 4))
        if quaternion is None:
            return None
        quaternion = np.broadcast_to(quaternion, (rows, 4))
        bad_rows: list[str] = []
        matrices = np.empty((rows, 3, 3))
        for i, q in enumerate(quaternion):
            try:
                matrices[i] = quaternion_to_matrix(q, scalar_first=True)
            except ValueError:
                bad_rows.append(f"{row_names[i]} = {np.array2string(q, separator=', ')}")
        self.problems.add_rows(self.where(name), bad_rows, "expected a quaternion (w, x, y, z) of length 1")
        return None if bad_rows else matrices

    def grid(self, height: int, width: int) -> SphereGrid | None:
        """Directions of the pixels; row i, column j at i and j steps from the horizon by default."""
        if "grid_deg" not in self.raw.arrays:
            return SphereGrid.hemisphere(height, width)
        values = self.real("grid_deg", (4,))
        if values is None:
            return None
        elevation, _, elevation_step, azimuth_step = values
        last = elevation + (height - 1) * elevation_step
        if not np.isfinite(values).all() or elevation_step <= 0 or azimuth_step <= 0:
            fault = "expected four finite numbers, the two steps positive"
        elif elevation < -90 - 1e-6 or last > 90 + 1e-6:
            fault = f"elevations run from {elevation:g} to {last:g}; expected -90 to 90"
        elif width * azimuth_step > 360 * (1 + 1e-6):
            fault = (
                f"{width} columns of {azimuth_step:g} degrees exceed the circle; expected at most 360 in all"
            )
        else:
            return SphereGrid(height, width, *(math.radians(v) for v in values))
        self.problems.add(self.where("grid_deg"), fault)
        return None

    def ragged(self, rows: int) -> np.ndarray | None:
        """path_offsets (S + 1,) int64."""
        offsets = self.raw.arrays.get("path_offsets")
        per_path = [
            n for n in self.raw.arrays if n.startswith("path_") and n in FIELDS and n != "path_offsets"
        ]
        if offsets is None:
            if per_path:
                self.problems.add(self.where("path_offsets"), f"missing, but {per_path[0]} is given")
            return None
        if not self.fits("path_offsets", offsets, (rows + 1,)):
            return None
        if offsets.dtype.kind not in "iu" or offsets[0] != 0 or (np.diff(offsets.astype(np.int64)) < 0).any():
            self.problems.add(
                self.where("path_offsets"), "expected integers that start at 0 and never decrease"
            )
            return None
        for name in per_path:
            found = self.raw.arrays[name].shape[:1]
            if found != (int(offsets[-1]),):
                self.problems.add(
                    self.where(name), f"expected {int(offsets[-1])} paths as path_offsets says, found {found}"
                )
                return None
        return offsets.astype(np.int64)

    def release_split(self, rows: int) -> tuple[np.ndarray, np.ndarray] | None:
        """(train, test) rows that the file names, or None."""
        given = [name for name in ("split_train", "split_test") if name in self.raw.arrays]
        if not given:
            return None
        if len(given) == 1:
            self.problems.add(self.source, f"{given[0]} is given alone; expected split_train and split_test")
            return None
        parts = []
        for name in given:
            index = self.raw.arrays[name]
            if not self.fits(name, index, (None,)):
                return None
            if index.dtype.kind not in "iu" or index.size == 0:
                self.problems.add(self.where(name), "expected row numbers (integers), at least one")
                return None
            out = index[(index < 0) | (index >= rows)]
            self.problems.add_rows(
                self.where(name), (f"row {i}" for i in out), f"out of range; rows are 0 to {rows - 1}"
            )
            values, counts = np.unique(index, return_counts=True)
            self.problems.add_rows(self.where(name), (f"row {i}" for i in values[counts > 1]), "named twice")
            parts.append(values.astype(np.int64))
        both = np.intersect1d(parts[0], parts[1])
        self.problems.add_rows(self.where("split_test"), (f"row {i}" for i in both), "also in split_train")
        return parts[0], parts[1]

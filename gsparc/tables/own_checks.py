"""What is wrong with a file of one's own: each check notes problems with array,
row and expectation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsparc.base.errors import list_first, suggest_name
from gsparc.data.assemble import check_positions
from gsparc.data.blocks import row_blocks
from gsparc.data.fields import FIELDS
from gsparc.data.schema import Stations, TrainTest
from gsparc.data.target import MEASUREMENTS, TARGETS, Kind
from gsparc.ops import SphereGrid
from gsparc.tables.array_checks import ArrayChecker
from gsparc.tables.arrays import name_rows_by_number

# From long wave (100 kHz) to the far infrared: what lies outside was mostly given in MHz or GHz.
LOWEST_HZ, HIGHEST_HZ = 1e5, 1e13
UNIT_TOLERANCE = 1e-2  # releases print quaternions with few digits; beyond this they are refused


class Checker(ArrayChecker):
    """Takes out what the schema knows: names, the measurement, ends, frequencies, grids, splits."""

    def check_names(self) -> None:
        """Refuse misspelt names and foreign units; note that other unknown names are ignored.

        Raises:
            DataError: arrays of another type or number of axes than the schema's: nobody else looks
                at these.
        """
        sound, arrays = True, self.given
        # What is ignored must not be taken for an array of the same name that is made of others.
        self.raw = replace(
            self.raw, arrays={name: arrays[name] for name in arrays if name in FIELDS}
        )
        for name in arrays:
            if name in FIELDS:
                unit = self.raw.units.get(name, FIELDS[name].unit)
                if unit != FIELDS[name].unit:
                    self.refuse(name, f"units are {unit!r}; expected {FIELDS[name].unit!r}")
                shapes = FIELDS[name].shapes
                # Channels and spectra may have an axis of stations behind that of rows.
                several = name in MEASUREMENTS and not MEASUREMENTS[name].is_level
                shapes += [(*shape, None) for shape in shapes] if several else []
                sound &= self.read_array(name, *shapes) is not None
                continue
            # A name that the file holds, too, cannot be what the misspelt one was to be.
            if hint := suggest_name(name, [other for other in FIELDS if other not in arrays], 0.6):
                self.refuse(name, f"unknown name{hint}")
            else:
                self.notes.append(f"{name}: not part of the schema, ignored")
        if not sound:
            self.problems.raise_if_any()

    def measurement(self) -> str | None:
        """Choose spectrum, csi, rssi or rssi_db: the only one,
        or the one that an attribute names.
        """
        present, named = self.present(*MEASUREMENTS), self.raw.attributes.get("measurement")
        if named is not None and named not in present:
            there = " and ".join(present) or "none of these"
            self.refuse(
                "measurement", f"{named!r} names no measurement of this file, which holds {there}"
            )
        if len(present) == 1:
            return present[0]
        if named in present:
            return str(named)
        rest = [f"{name} {array.shape}" for name, array in self.given.items()] or [
            "no arrays outside groups"
        ]
        names = " and ".join(present) or (
            f"none of them among {list_first(rest, 8)}; rename what it is"
        )
        wanted = f"expected exactly one of {', '.join(MEASUREMENTS)}"
        return self.problems.add(self.source, f"{wanted}; found {names}")

    def name_rows(self, rows: int, stations: Stations | None) -> list[str]:
        """Return what messages call each row: `row_name`, or its number, with its station."""
        arrays, named = self.raw.arrays, name_rows_by_number(rows).tolist()
        if "row_name" in arrays and self.has_shape("row_name", arrays["row_name"], (rows,)):
            named = [str(name) for name in arrays["row_name"]]
        if stations is not None:  # a place alone would name several rows
            labels, pairs = stations.shown, zip(named, arrays["station"], strict=True)
            named = [f"{row}, station {labels[t]}" for row, t in pairs]
        self.row_names = named
        return named

    def read_positions(self, name: str, rows: int | None) -> np.ndarray | None:
        """Return (S, 3) or (3,) float64 [m]."""
        if name not in self.raw.arrays:
            remedy = "; or say dataset.tx_position=[X,Y,Z]" if name == "tx_position" else ""
            return self.refuse(
                name, f"missing; expected {FIELDS[name].shape} [{FIELDS[name].unit}]{remedy}"
            )
        array = self.read_real(name, (3,), (rows, 3))
        if array is None:
            return None
        # Places that nobody gave are NaN on purpose and pass unchecked.
        if name == self.unknown:
            return array
        names = (
            (self.row_names or name_rows_by_number(len(array)).tolist())
            if array.ndim == 2
            else ["its value"]
        )
        if check_positions(self.problems, self.describe_array(name), np.atleast_2d(array), names):
            return None
        stored = self.raw.arrays[name]
        # Distance to the next number: at a UTM northing
        # of 5,000 km float32 has steps of half a metre.
        step = float(np.spacing(np.abs(stored).max(initial=0))) if stored.dtype.kind == "f" else 0.0
        if stored.dtype.itemsize <= 4 and step > 1e-3:
            self.notes.append(
                f"{name}: stored as {stored.dtype} this far from the origin, it moves in steps of "
                f"{step * 1e3:.1f} mm; store float64"
            )
        return array

    def check_range(self, name: str, values: np.ndarray, mask: np.ndarray | None) -> None:
        """Refuse rows of which a measured entry of `values` (S, ...) is not finite,
        or beyond all powers.
        """
        # Magnitudes of complex64 overflow and comparisons with NaN warn; both are tested for here.
        with np.errstate(over="ignore", invalid="ignore"):
            unmarked = "not finite; expected numbers (mark what was not measured in mask)"
            self.refuse_rows(name, rows_with(values, are_infinite, mask), unmarked)
            followed = str(self.raw.attributes.get("conventions", "")).split()
            fault = MEASUREMENTS[name].fault(name)
            if fault is None or values.dtype.kind == "u" or "decibels" in followed:
                return
            is_out, wanted = fault
            out = rows_with(values, is_out, mask)
        self.refuse_rows(name, out, f"out of range; expected {wanted}")

    def read_devices(
        self, rows: int, kind: Kind
    ) -> tuple[tuple[str, ...] | None, np.ndarray | None]:
        """Return names (D,) of devices and which of them measured each row (S,) int64;
        None where none is.
        """
        array = self.read_array("device", (rows,))
        if array is None:
            return None, None
        if not TARGETS[kind].is_level:
            self.refuse("device", f"goes with powers, not with {kind}")
        names, device = np.unique(array.astype(str), return_inverse=True)
        return tuple(names.tolist()), device.reshape(-1).astype(np.int64)

    def read_sequence(self, rows: int, kind: Kind) -> np.ndarray | None:
        """Return numbers (S,) int64 of powers in the order of their times; None: as they stand."""
        time = self.read_array("time_s", (rows,)) if TARGETS[kind].is_level else None
        if time is None or not np.isfinite(time).all() or (np.diff(time) >= 0).all():
            return None
        return np.argsort(np.argsort(time, kind="stable"))

    def read_mask(
        self, shape: tuple[int, ...], censored: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Return bool, like the measurement; None: all was measured.
        Only `censored` rows may be empty.
        """
        array = self.read_array("mask", shape)
        if array is None:
            return None
        if not np.isin(array, (0, 1)).all():
            return self.refuse(
                "mask", f"expected True and False, found {array.dtype} of other values"
            )
        mask = array.astype(bool)
        # A row without a measured entry has no error to learn from and no power to scale by.
        empty = ~mask.reshape(len(mask), -1).max(axis=1)
        if censored is not None:
            empty &= censored == 0
        self.refuse_rows("mask", empty, "nothing measured; expected a True, or drop the row")
        return mask

    def read_frequencies(self, count: int | None) -> tuple[np.ndarray | None, float | None]:
        """Return (K,) [Hz] or None, and the carrier [Hz] or None;
        csi needs `count` (None without csi).
        """
        frequency = self.read_real("frequency_hz", (), (None,) if count is None else (count,))
        carrier, spacing = (self.read_real(name, ()) for name in ("carrier_hz", "spacing_hz"))
        if count is not None and frequency is None and carrier is not None and spacing is not None:
            frequency = (np.arange(count) - count // 2) * spacing
        elif count is not None and "frequency_hz" not in self.raw.arrays:
            fault = (
                f"missing; csi needs the {count} frequencies [Hz]; or say "
                "dataset.frequency_hz=[...]"
            )
            self.refuse("frequency_hz", f"{fault}, or dataset.carrier_hz=HZ dataset.spacing_hz=HZ")
        if frequency is not None and carrier is not None and frequency.size:
            away = np.abs(frequency)
            # Values in MHz are far from 0
            if 2 * away.max() < carrier and away.min() <= np.ptp(frequency):
                self.notes.append(
                    f"frequency_hz: read as offsets from carrier_hz, {float(carrier):g}"
                )
                frequency = frequency + carrier
        for name, values in (("frequency_hz", frequency), ("carrier_hz", carrier)):
            if values is None:
                continue
            if values.size == 0 or not np.all((values >= LOWEST_HZ) & (values <= HIGHEST_HZ)):
                fault = f"{np.array2string(values, threshold=4)} is outside {LOWEST_HZ:.0e} to"
                self.refuse(name, f"{fault} {HIGHEST_HZ:.0e}; expected Hz (not MHz or GHz)")
                return None, None
            if len(np.unique(values)) != values.size:
                self.refuse(name, "the same frequency twice; expected distinct ones [Hz]")
        if frequency is None:
            return None, None if carrier is None else float(carrier)
        # A single frequency with several columns: they may be antennas,
        # and then the shape is wrong.
        if frequency.ndim == 0 and count not in (None, 1):
            self.refuse(
                "frequency_hz",
                f"one frequency, but csi has {count} columns; expected {count} frequencies, "
                "or csi of shape (S, A, 1) when its columns are antennas",
            )
            return None, None
        return np.atleast_1d(frequency), float(frequency.mean() if carrier is None else carrier)

    def fits_exchanged(self, antennas: int, tones: int) -> bool:
        """Tell whether frequencies and antennas fit channels with exchanged axes alone."""
        shapes = {name: array.shape for name, array in self.raw.arrays.items()}

        def fits(antennas: int, tones: int) -> bool:
            places = shapes.get("array_position", (antennas, 3))
            return shapes.get("frequency_hz", ()) in ((), (tones,)) and places == (antennas, 3)

        return fits(tones, antennas) and not fits(antennas, tones)

    def read_rotation(self, rows: int) -> np.ndarray | None:
        """Return (S, 3, 3) local to world; the identity when the file says nothing."""
        present = self.present("rx_orientation", "rx_rotation")
        # Two statements of one rotation can disagree, and nothing says which is right.
        if len(present) == 2:
            fault = "rx_orientation and rx_rotation are both given; expected one of them"
            return self.problems.add(self.source, fault)
        if not present:
            return np.tile(np.eye(3), (rows, 1, 1))
        shape = (4,) if present == ["rx_orientation"] else (3, 3)
        values = self.read_real(present[0], shape, (rows, *shape))
        if values is None:
            return None
        values = np.broadcast_to(values, (rows, *shape))
        if present == ["rx_rotation"]:
            expected = (
                "not a rotation; expected an orthogonal matrix with determinant +1, "
                "receiver to world"
            )
            return (
                None
                if self.refuse_rows("rx_rotation", ~is_rotation(values), expected)
                else values.copy()
            )
        return self.to_matrices("rx_orientation", values, self.row_names)

    def to_matrices(self, name: str, values: np.ndarray, rows: Sequence[str]) -> np.ndarray | None:
        """Return rotations (n, 3, 3) of quaternions (n, 4) of an array."""
        where, expected = (
            self.describe_array(name),
            ("expected a quaternion (w, x, y, z) of length 1"),
        )
        bad = self.problems.add_values(where, rows, values, is_unit(values), expected)
        return None if bad else quaternion_to_matrix(values, scalar_first=True)

    def read_grid(self, height: int, width: int) -> SphereGrid | None:
        """Return directions of the pixels; by default row i,
        column j at i and j steps from the horizon.
        """
        if "grid_deg" not in self.raw.arrays:
            return SphereGrid.hemisphere(height, width)
        values = self.read_real("grid_deg", (4,))
        if values is None:
            return None
        elevation, _, elevation_step, azimuth_step = values
        last = elevation + (height - 1) * elevation_step
        if not np.isfinite(values).all() or elevation_step <= 0 or azimuth_step <= 0:
            return self.refuse("grid_deg", "expected four finite numbers, the two steps positive")
        # Rounded steps of whole hemispheres end at 90 degrees but for some digits.
        if elevation < -90 - 1e-6 or last > 90 + 1e-6:
            fault = f"elevations run from {elevation:g} to {last:g}; expected -90 to 90"
            return self.refuse("grid_deg", fault)
        if width * azimuth_step > 360 * (1 + 1e-6):
            fault = f"{width} columns of {azimuth_step:g} degrees exceed the circle"
            return self.refuse("grid_deg", f"{fault}; expected at most 360 in all")
        return SphereGrid(height, width, *(math.radians(v) for v in values))

    def read_ragged(self, rows: int) -> np.ndarray | None:
        """Return path_offsets (S + 1,) int64."""
        per_path = self.present(
            *(n for n in FIELDS if n.startswith("path_") and n != "path_offsets")
        )
        if per_path and "path_offsets" not in self.raw.arrays:
            return self.refuse("path_offsets", f"missing, but {per_path[0]} is given")
        offsets = self.read_array("path_offsets", (rows + 1,))
        if offsets is None:
            return None
        # Cast first: differences of unsigned integers wrap around and never are negative.
        if offsets[0] != 0 or (np.diff(offsets.astype(np.int64)) < 0).any():
            return self.refuse(
                "path_offsets", "expected integers that start at 0 and never decrease"
            )
        for name in per_path:
            shape, count = self.raw.arrays[name].shape[:1], int(offsets[-1])
            if shape != (count,):
                return self.refuse(
                    name, f"expected {count} paths as path_offsets says, found {shape}"
                )
        return offsets.astype(np.int64)

    def read_split(self, rows: int) -> TrainTest | None:
        """Return (train, test) rows that the file names, or None."""
        names = self.present("split_train", "split_test")
        if len(names) == 1:
            self.problems.add(
                self.source, f"{names[0]} is given alone; expected split_train and split_test"
            )
        if len(names) < 2:
            return None
        parts = []
        for name in names:
            index = self.raw.arrays[name]
            if index.size == 0:
                return self.refuse(name, "expected a row number or more")
            out = index[(index < 0) | (index >= rows)]
            values, counts = np.unique(index, return_counts=True)
            self._refuse_numbers(name, out, f"out of range; rows are 0 to {rows - 1}")
            self._refuse_numbers(name, values[counts > 1], "named twice")
            parts.append(values.astype(np.int64))
        self._refuse_numbers(
            "split_test", np.intersect1d(parts[0], parts[1]), "also in split_train"
        )
        return parts[0], parts[1]

    def _refuse_numbers(self, name: str, rows: np.ndarray, what: str) -> None:
        self.problems.add_rows(self.describe_array(name), (f"row {i}" for i in rows), what)


def rows_with(
    values: np.ndarray, test: Callable[[np.ndarray], np.ndarray], mask: np.ndarray | None = None
) -> np.ndarray:
    """Tell which rows (S,) of `values` (S, ...) have a measured entry that passes a test,
    by blocks.
    """
    passed = (test(values[p]) & (True if mask is None else mask[p]) for p in row_blocks(values))
    return np.concatenate([part.reshape(len(part), -1).any(1) for part in passed])


def are_infinite(values: np.ndarray) -> np.ndarray:
    """Tell which of `values` are NaN or infinite, bool."""
    return ~np.isfinite(np.abs(values))


def is_unit(quaternion: np.ndarray) -> np.ndarray:
    """Tell whether quaternions (..., 4) are finite, of length 1 within `UNIT_TOLERANCE`: (...)
    bool.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return np.abs(np.linalg.norm(quaternion, axis=-1) - 1) <= UNIT_TOLERANCE


def quaternion_to_matrix(quaternion: np.ndarray, *, scalar_first: bool) -> np.ndarray:
    """Return rotation matrices (..., 3, 3), local to world, of quaternions (..., 4) of length 1."""
    # SciPy expects the scalar last and normalises, which removes the rounding of printed digits.
    q = np.roll(quaternion, -1, axis=-1) if scalar_first else quaternion
    return Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)


def is_rotation(matrix: np.ndarray, tolerance: float = 1e-3) -> np.ndarray:
    """Tell whether matrices (..., 3, 3) are orthogonal with determinant +1: (...) bool."""
    # Products of huge or missing numbers are refused below, so that NumPy need not warn.
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(axis=(-1, -2))
        return (error <= tolerance) & (np.linalg.det(matrix) > 0)

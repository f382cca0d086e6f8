"""Arrays as other tools call and shape them, under the schema's names."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from gsparc.base.errors import Caution
from gsparc.data.schema import FIELDS
from gsparc.data.units import UNITS
from gsparc.tables.amplitudes import join_polar
from gsparc.tables.heads import CHANNELS, LISTS, PARTS, POLAR, words_of
from gsparc.tables.raw import Raw, rename_arrays

MOST_AXES = 3  # of channels of one static end


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


FIELD_OF = {_plain(other): field.name for field in FIELDS.values() for other in field.also.split()}


def _joined(raw: Raw) -> Raw:
    """The same with real and imaginary parts, or amplitudes and phases,
    of channels as one complex array.
    """
    parts = dict[str, str]()
    for name in raw.arrays:
        words = words_of(name)
        roles = {PARTS[word] for word in words if word in PARTS}
        if len(roles) == 1 and {*words} <= {*PARTS, *LISTS["channel"], *UNITS}:
            parts.setdefault(roles.pop(), name)
    for pair in (CHANNELS, POLAR):
        names = [parts[part] for part in pair if part in parts]
        if (
            len(names) < 2
            or raw.arrays[names[0]].shape != raw.arrays[names[1]].shape
            or "csi" in raw.arrays
        ):
            continue
        units = [UNITS.get(words_of(name)[-1]) for name in names]
        first, second = (raw.arrays[name].astype(np.float64) for name in names)
        second = second if units[1] is None else units[1].convert(second)
        polar = pair == POLAR
        csi, notes = (
            join_polar(first, second, units) if polar else (first + 1j * second, list[str]())
        )
        notes = [f"{' and '.join(names)}: taken as {' and '.join(pair)} of csi", *notes]
        arrays = {name: array for name, array in raw.arrays.items() if name not in names}
        return replace(raw, arrays={**arrays, "csi": csi}, notes=(*raw.notes, *notes))
    return raw


def name_arrays(raw: Raw) -> Raw:
    """Return `raw` with `fields.csv`'s other names of arrays replaced,
    and channels as complex (S, ...).

    Real numbers with an axis of two become real and imaginary parts; axes of length 1 go where
    there are more than `MOST_AXES`, or where one place is written (1, 3).
    """
    raw, names = _joined(raw), dict[str, str]()
    for name, array in raw.arrays.items():
        field = FIELD_OF.get(_plain(name), name)
        used_names = {*raw.arrays, *names.values()}
        channel = array.dtype.kind == "c" or _parts(array) or re.search("amp|mag|abs", name)
        if name not in FIELDS and field not in used_names and (field != "csi" or channel):
            names[name] = field
    arrays, notes = (
        rename_arrays(raw, names).arrays,
        [f"{name}: taken as {names[name]}" for name in names],
    )
    csi = arrays.get("csi", np.zeros(0))
    if axis := _parts(csi):
        first, second = np.moveaxis(csi, axis, 0).astype(np.float64)
        csi = first + 1j * second
        notes.append(
            Caution(f"csi: real numbers, taken as real and imaginary parts along axis {axis}")
        )
    if csi.ndim > MOST_AXES and not any(name.startswith("station_") for name in arrays):
        csi = csi.reshape(len(csi), *(count for count in csi.shape[1:] if count > 1))
    arrays |= {"csi": csi} if "csi" in arrays else {}
    for name in ("rx_position", "tx_position"):
        if name in arrays and arrays[name].shape[:1] == (1,) and len(csi) != 1:
            arrays[name] = arrays[name].reshape(arrays[name].shape[1:])
    return replace(rename_arrays(raw, names), arrays=arrays, notes=(*raw.notes, *notes))


def _parts(array: np.ndarray) -> int:
    """Which axis of real numbers, some below 0, holds their real and imaginary parts; 0: none."""
    real = array.dtype.kind in "if" and array.ndim > 1 and bool((array < 0).any())
    return next((axis for axis in (array.ndim - 1, 1) if real and array.shape[axis] == 2), 0)

"""Arrays as other tools call and shape them, under the schema's names; amplitudes of channels,
complex with phases, else levels of as many stations as there are entries.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsparc.base.errors import Caution
from gsparc.data.fields import FIELDS
from gsparc.data.units import UNITS, Unit
from gsparc.tables.arrays import Raw, rename_arrays
from gsparc.tables.heads import CHANNELS, LISTS, PARTS, POLAR, words_of

# What powers do not have
PHASED = ("csi", "frequency_hz", "mask", "noise_variance", "array_position")


TURN = 6.3  # radians of a full turn, and a little: larger phases are degrees


def join_polar(
    amplitude: np.ndarray, phase: np.ndarray, units: Sequence[Unit | None]
) -> tuple[np.ndarray, list[str]]:
    """Return complex channels of amplitudes and phases in the schema's units,
    and a note where it is a guess.

    Args:
        amplitude, phase: of one shape; phases of a unit are in degrees.
        units: of both, as they were written; None: linear, and radians unless one is over a turn.
    """
    degrees = units[1] is not None or np.nanmax(np.abs(phase)) > TURN
    notes = [] if units[1] else [f"phases are taken as {'degrees' if degrees else 'radians'}"]
    size = (
        10 ** (amplitude / 20) if units[0] is not None and units[0].kind == "level" else amplitude
    )
    return size * np.exp(1j * (np.radians(phase) if degrees else phase)), notes


def amplitudes_to_levels(raw: Raw) -> Raw:
    """Return absolute values (S,), (S, K) or (S, A, K)
    in place of complex `csi` as levels `rssi_db`.

    An antenna's tone is a station at the static end's place, with a carrier of its own. Anything
    else is returned as it is.
    """
    arrays = dict(raw.arrays)
    csi = arrays.get("csi", np.zeros(0, complex))
    if (
        csi.dtype.kind not in "fiu"
        or not 0 < csi.ndim < 4
        or (csi < 0).any()
        or not np.unique(csi)[1:].size
    ):
        return raw
    each = csi.reshape(len(csi), -1)
    several = each.shape[1] > 1
    ends = [end for end in ("tx", "rx") if f"{end}_position" in arrays]
    still = [
        end for end in ends if len(np.unique(np.atleast_2d(arrays[f"{end}_position"]), axis=0)) == 1
    ]
    if several and ("station" in arrays or len(ends) - len(still) > 1):
        return raw
    if "mask" in arrays and arrays["mask"].shape == csi.shape:
        each = np.where(arrays["mask"].reshape(each.shape), each, np.nan)
    heard = (each > 0).any(axis=0)  # guard tones are 0 in every row
    with np.errstate(divide="ignore"):  # silence is a level that is missing
        level = 20 * np.log10(np.where(each > 0, each, np.nan))[:, heard]
    tones = np.broadcast_to(arrays.get("frequency_hz", np.nan), csi.shape[1:]).ravel()[heard]
    arrays = {name: values for name, values in arrays.items() if name not in PHASED}
    arrays |= {"rssi_db": level if several else level[:, 0]}
    if np.isfinite(tones).all():
        arrays.setdefault("carrier_hz", tones if several else tones[0])
    note = "csi: absolute values, no phases: taken as levels"
    if several:
        place = np.full(3, np.nan)
        for end in still:
            place = np.atleast_2d(arrays.pop(f"{end}_position"))[0]
            if f"{end}_height" in arrays:
                arrays["station_height"] = arrays.pop(f"{end}_height")
        arrays["station_position"] = np.tile(place, (heard.sum(), 1))
        named = np.ndindex(csi.shape[1:])
        words = ("tone",) if csi.ndim == 2 else ("antenna", "tone")
        names = [" ".join(f"{w} {i}" for w, i in zip(words, index, strict=True)) for index in named]
        arrays["station_name"] = np.array(names)[heard]
        note += f" of {heard.sum()} stations, one for each {' and '.join(words)}"
    return replace(
        raw, arrays=arrays, notes=(*raw.notes, f"{note}; with phases write complex numbers")
    )


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

"""Amplitudes of channels: complex with phases,
else levels of as many stations as there are entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsparc.data.units import Unit
from gsparc.tables.raw import Raw

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

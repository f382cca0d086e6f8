"""Values of a file of the schema: as they are checked, and as they are stored."""

from __future__ import annotations

import numpy as np

from gsparc.data.blocks import is_big, write_blocks
from gsparc.data.fields import FIELDS
from gsparc.data.target import MEASUREMENTS, Kind
from gsparc.tables.own_checks import Checker


def read_measured(check: Checker, name: str) -> tuple[np.ndarray | None, Kind]:
    """The measurement as (S, H, W), (S, A, K) or (S, 1), and its kind; None when unusable."""
    facts = MEASUREMENTS[name]
    kind = facts.kind
    array = check.read_array(name, *([(None,)] if facts.is_level else FIELDS[name].shapes))
    if array is None:
        return None, kind
    if facts.is_complex and array.size:
        array = array.reshape(len(array), -1, array.shape[-1] if array.ndim > 1 else 1)
    if is_big(array) and not facts.is_level and len(array) > 1 and "mask" not in check.raw.arrays:
        return array, kind  # its blocks are cast where they are read
    # Magnitudes of complex64 overflow, units of 1e-42 are lost.
    if facts.is_level or array.dtype.kind in "fc":
        array = array.astype(np.complex128 if array.dtype.kind == "c" else np.float64)
    if facts.is_level:
        array = array[:, None]
    if len(array) < 2 or array.size == 0:
        fault = f"shape {array.shape} holds too little; expected two rows or more"
        return check.refuse(name, fault), kind
    return array, kind


def read_not_negative(check: Checker, name: str, rows: int) -> np.ndarray | None:
    """An array () or (S,) as (S,) float64."""
    array = check.read_real(name, (), (rows,))
    if array is None:
        return None
    values = np.broadcast_to(array, (rows,)).copy()
    bad = ~(np.isfinite(values) & (values >= 0))
    check.refuse_rows(name, bad, "expected a finite number, at least 0")
    return values


def read_directions(
    check: Checker, offsets: np.ndarray | None, rx: np.ndarray, rotation: np.ndarray
) -> list[np.ndarray] | None:
    """Unit vectors (paths, 3) of each sample in the receiver's frame."""
    present = check.present("path_direction", "path_last_point")
    if offsets is None or not present:
        return None
    name = present[0]
    vectors = check.read_real(name, (int(offsets[-1]), 3))
    if vectors is None:
        return None
    owner = np.repeat(np.arange(len(rx)), np.diff(offsets))
    if name == "path_last_point":
        # Transposed rotation: from the world to the receiver's frame,
        # in which spectra and arrays are.
        vectors = np.einsum("pji,pj->pi", rotation[owner], vectors - rx[owner])
    # Directions of any length are taken, so that overflow here is a row to refuse, not an error.
    with np.errstate(over="ignore"):
        length = np.linalg.norm(vectors, axis=-1)
    bad = np.flatnonzero(~(np.isfinite(length) & (length > 0)))
    if len(bad):
        paths, expected = (f"path {i}" for i in bad), "expected a direction that is not zero"
        return check.problems.add_rows(check.describe_array(name), paths, expected)
    return np.split((vectors / length[:, None]).astype(np.float32), offsets[1:-1])


def scale_values(
    name: str, values: np.ndarray, mask: np.ndarray | None, censored: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """The target as stored and the constant it was divided by (0 for silence);
    censored rows are levels.
    """
    mask_or_level = mask
    if censored is not None:
        # A censored row's target is the level of hearing,
        # which the loss needs though the mask says False.
        bound = censored[:, None] != 0
        mask_or_level = bound if mask is None else mask | bound
    if mask_or_level is not None:
        values = np.where(mask_or_level, values, np.zeros((), values.dtype))
    if values.dtype == np.uint8:
        return values, 1.0 if values.any() else 0.0
    facts, given = MEASUREMENTS[name], values
    values = facts.linear(name, given)
    if values is not given and mask_or_level is not None:
        values = values * mask_or_level
    scale = facts.scale(values, mask)
    if scale <= 0:
        return values, 0.0
    lift = 2.0**200 if scale < 1e-290 else 1.0  # exact; units of 1e-310 have no reciprocal
    divisor = scale * lift
    stored, exact = facts.types
    with np.errstate(over="ignore"):  # what is then infinite is refused by row
        if mask_or_level is not None or values is not given or not is_big(values):
            return (values * lift / divisor).astype(stored), scale
        return write_blocks(
            values.shape, stored, lambda at: values[at].astype(exact) * lift / divisor
        ), scale

"""Rows where nothing was heard: the power there lies below a known level (`Measurements.censored`)."""

from __future__ import annotations

import numpy as np

from gsparc.data.schema import Measurements


def silent(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Where of rows (n,) nothing was heard, (n,) bool."""
    return np.zeros(len(rows), bool) if data.censored is None else data.censored[rows]


def heard(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Those of rows (n,) where something was heard, in their order."""
    return rows[~silent(data, rows)]


def left_out_note(data: Measurements, rows: np.ndarray) -> tuple[str, ...]:
    """What a reader must know of a fit to `heard(data, rows)`; nothing where all of rows (n,) were heard."""
    count = int(silent(data, rows).sum())
    return (f"{count} rows where nothing was heard are not learned from",) if count else ()

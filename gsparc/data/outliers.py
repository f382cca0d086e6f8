"""Rows far beyond all others, by median and median absolute deviation: damaged bytes, wrong units, sentinels.

They are named where data are checked and read, set no scale, and are learned from and tested on unless
`split.leave_out=outliers` says otherwise.
"""

from __future__ import annotations

import numpy as np

from gsparc.data.schema import Measurements

LOUD_DB = 60.0  # above the median row: twice the range of a room with a receiver beside its transmitter
SPREADS = 10.0  # median absolute deviations scaled to a normal's standard deviation
FAR = 100.0  # times the median distance from the median place
NAMED = 5  # rows in a message


def loud(peaks: np.ndarray) -> np.ndarray:
    """Rows (S,) bool whose largest magnitude `peaks` (S,) is far above the others'; silent rows are not."""
    with np.errstate(divide="ignore"):
        level = 20 * np.log10(np.asarray(peaks, dtype=np.float64))
    known = np.isfinite(level)
    if not known.any():
        return np.zeros(len(level), bool)
    middle = np.median(level[known])
    spread = 1.4826 * np.median(np.abs(level[known] - middle))
    return known & (level > middle + max(LOUD_DB, SPREADS * spread))


def far(positions: np.ndarray) -> np.ndarray:
    """Rows (S,) bool of `positions` (S, 3) [m] that lie far outside the region of the others."""
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return distance > FAR * np.median(distance)


def peaks(values: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Largest magnitude (S,) of the measured entries of rows `values` (S, ...)."""
    magnitude = np.abs(values if mask is None else np.where(mask, values, 0))
    return magnitude.reshape(len(values), -1).max(axis=1, initial=0)


def outliers(data: Measurements) -> dict[str, np.ndarray]:
    """Rows (n,) by what is wrong with them."""
    amplitude = peaks(data.target, data.mask)
    amplitude = np.sqrt(amplitude) if data.site.kind == "rssi" else amplitude
    found = {
        "measure far more power than all others": np.flatnonzero(loud(amplitude)),
        "lie far outside the region of all others": np.flatnonzero(far(data.moving)),
    }
    return {what: rows for what, rows in found.items() if len(rows)}


def warnings(data: Measurements) -> list[str]:
    """One sentence for each kind of outlier, with the names of the first rows."""
    said = []
    for what, rows in outliers(data).items():
        names = ", ".join(data.row_names[i] for i in rows[:NAMED])
        more = f" and {len(rows) - NAMED} more" if len(rows) > NAMED else ""
        said.append(f"{names}{more}: {what}; if they are wrong, leave them out with split.leave_out=outliers")
    return said

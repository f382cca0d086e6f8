"""What rows of a site have in common: their size, but for few rows far beyond all others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsparc.data.blocks import row_blocks

FEW = 0.02  # share of the rows, at least one row
GAP_DB = 50.0  # to the next row: no step of a receiver between two of its neighbours is as high


def rounded_rms(values: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Return the root mean square of rows `values` (S, ...), real or complex, in whole dB;
    0 if all are zero.

    This is a constant of the site, taken over all rows but those of `find_strong_outliers`:
    rounding keeps any single row (which may be a test row) from influencing it.
    `weight` is a bool mask of measured entries.
    """
    highest = peak_magnitudes(values, weight)
    usual = ~find_strong_outliers(highest)
    peak = float(highest[usual].max(initial=0.0))
    if peak == 0.0:
        return 0.0
    total, count = 0.0, 0
    for part in row_blocks(values):
        rows = values[part][usual[part]]
        # Relative to the peak, so that squares of 1e-200 or 1e200 neither vanish nor overflow.
        rows = rows if weight is None else rows[weight[part][usual[part]]]
        magnitude = np.abs(rows).astype(np.float64) / peak
        total, count = total + float((magnitude**2).sum()), count + magnitude.size
    return float(10 ** (round(20 * np.log10(peak * np.sqrt(total / count))) / 20))


def peak_magnitudes(values: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the largest magnitude (S,) of the measured entries of rows `values` (S, ...)."""
    highest = []
    for part in row_blocks(values):
        magnitude = np.abs(values[part] if mask is None else np.where(mask[part], values[part], 0))
        highest.append(magnitude.reshape(len(magnitude), -1).max(axis=1, initial=0))
    return np.concatenate(highest)


def find_strong_outliers(peaks: np.ndarray) -> np.ndarray:
    """Tell which rows (S,) have a largest magnitude, `peaks` (S,), far above all others';
    no silent ones.
    """
    with np.errstate(divide="ignore"):
        level = 20 * np.log10(np.asarray(peaks, dtype=np.float64))
    finite = np.isfinite(level)
    strong = np.zeros(len(level), bool)
    strong[finite] = few_beyond(level[finite], lambda inner, outer: outer - inner > GAP_DB)
    return strong


def few_beyond(values: np.ndarray, gap: Callable[[float, float], bool]) -> np.ndarray:
    """Tell which of `values` (n,), the largest and few of them, lie above a gap; (n,) bool."""
    order = np.argsort(values, kind="stable")
    for count in range(min(max(1, int(FEW * len(values))), len(values) - 1), 0, -1):
        if gap(values[order[-count - 1]], values[order[-count]]):
            return np.isin(np.arange(len(values)), order[-count:])
    return np.zeros(len(values), bool)

"""Rows that methods learn from: holes filled, and what was not heard."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from gsparc.data.blocks import take
from gsparc.data.schema import Measurements
from gsparc.data.target import TARGETS
from gsparc.processes.powers import PowerRows


def training_targets(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return targets of `rows` in stored type and units;
    unmeasured entries are means of other rows.

    Many large ones of a file stay on disk. Rows of which only a level is known (`data.censored`)
    keep it.

    Returns:
        (n, ...) like `data.target`; an entry measured in no row is 0.
    """
    target = take(data.target, rows)
    if data.mask is None or data.mask[rows].all():
        return target
    measured = data.mask[rows]
    total = np.where(measured, target, 0).sum(0) / np.maximum(measured.sum(0), 1)
    if data.censored is not None:
        measured = measured | (data.censored_side(rows) != 0).reshape(-1, *(1,) * (target.ndim - 1))
    return np.where(measured, target, total.astype(target.dtype))


def linear_moments(level: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return levels (B,) [dB] as linear targets (B, 1), and variances (B,)
    [dB^2] as those of targets.
    """
    power = TARGETS["rssi"].to_targets(level[:, None], (1,))
    return power, TARGETS["rssi"].entry_variance(variance, power)


def heard_rows(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return those of rows (n,) that were heard, in their order;
    a saturated one counts as its level.
    """
    return rows[data.censored_side(rows) <= 0]


def unheard_note(data: Measurements, rows: np.ndarray, method: str) -> tuple[str, ...]:
    """Say what a fit of `method` to `heard_rows(data, rows)`, rows (n,), left out, if anything."""
    side, notes = data.censored_side(rows), {1: "where nothing was heard are not learned from"}
    notes[-1] = "in saturation are learned from as if measured at that level"
    return tuple(
        f"{method}: {n} rows {text}" for s, text in notes.items() if (n := int((side == s).sum()))
    )


def power_rows(data: Measurements, rows: np.ndarray) -> PowerRows:
    """Return powers of rows (n,) in decibels, levels where they are censored."""
    decibels = data.site.target.to_real(training_targets(data, rows))[:, 0].astype(np.float64)
    return PowerRows(data.moving[rows], decibels, data.censored_side(rows))

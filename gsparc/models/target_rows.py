"""Targets as real rows in the units interpolation is fair in, and back."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsparc.data.blocks import take
from gsparc.data.schema import Kind, Measurements
from gsparc.physics.decibels import RELATIVE_DB
from gsparc.processes.powers import PowerRows

TINY_POWER = 1e-30  # -300 dB; only so that a logarithm exists


def training_targets(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return targets of `rows` in stored type and units; unmeasured entries are means of other rows.

    Many large ones of a file stay on disk. Rows of which only a level is known (`data.censored`) keep it.

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


def to_real(target: np.ndarray, kind: Kind) -> np.ndarray:
    """Return stored targets (n, ...) as float32 rows (n, D).

    Spectra are rows of pixels in [0, 1], channels real and imaginary parts in linear units, powers decibels.
    """
    if kind == "csi":
        # ascontiguousarray: a view as pairs needs the last axis dense.
        return np.ascontiguousarray(target, dtype=np.complex64).reshape(len(target), -1).view(np.float32)
    rows = target.reshape(len(target), -1).astype(np.float32)
    if kind == "rssi":
        return 10 * np.log10(np.maximum(rows, TINY_POWER, dtype=np.float32))
    return rows / np.float32(255) if target.dtype == np.uint8 else rows


def decibels(power: Tensor) -> Tensor:
    """Return powers in decibels, of none the least that has a logarithm."""
    return 10 * power.clamp_min(TINY_POWER).log10()


def to_targets(rows: Tensor, kind: Kind, shape: tuple[int, ...]) -> Tensor:
    """Return float32 rows (B, D) as targets (B, *shape) in stored units; spectra are clamped to [0, 1]."""
    if kind == "csi":
        return torch.view_as_complex(rows.reshape(len(rows), -1, 2)).reshape(len(rows), *shape)
    rows = rows.reshape(len(rows), *shape)
    return (10 ** (rows / 10)) if kind == "rssi" else rows.clamp(0.0, 1.0)


def linear_powers(decibels: Tensor) -> Tensor:
    """Return decibels (B,) as linear targets (B, 1)."""
    return to_targets(decibels[:, None], "rssi", (1,))


def to_entry_variance(variance: Tensor, mean: Tensor, kind: Kind) -> Tensor:
    """Turn the variance (B,) per real number of `to_real` into the squared error (B,) expected per entry.

    Complex entries hold two real numbers; decibels are carried to linear power to first order.
    """
    if kind == "csi":
        return 2 * variance
    if kind == "rssi":
        return variance * (mean.flatten(1).mean(1) / RELATIVE_DB) ** 2
    return variance


def heard_rows(data: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return those of rows (n,) that were heard, in their order; a saturated one counts as its level."""
    return rows[data.censored_side(rows) <= 0]


def unheard_note(data: Measurements, rows: np.ndarray, method: str) -> tuple[str, ...]:
    """Say what a fit of `method` to `heard_rows(data, rows)`, rows (n,), left out, if anything."""
    side, notes = data.censored_side(rows), {1: "where nothing was heard are not learned from"}
    notes[-1] = "in saturation are learned from as if measured at that level"
    return tuple(f"{method}: {n} rows {said}" for s, said in notes.items() if (n := int((side == s).sum())))


def power_rows(data: Measurements, rows: np.ndarray) -> PowerRows:
    """Return powers of rows (n,) in decibels, levels where they are censored."""
    decibels = to_real(training_targets(data, rows), "rssi")[:, 0].astype(np.float64)
    return PowerRows(data.moving[rows], decibels, data.censored_side(rows))

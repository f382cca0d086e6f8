"""Pseudo-positions of uplinks, for methods that need a place: principal components of their features."""

from __future__ import annotations

import numpy as np

ANTENNA_PAIRS = 64  # pairs of antennas that are compared, at most; drawn with a fixed seed
FLOOR = 1e-12
DEVIATION_M = 30.0  # of each coordinate: lengths are of the order of metres


def uplink_places(uplink: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return places (S, 3) float64 [m] of uplinks (S, A, L).

    The first three principal components of `features`, by training rows alone: uplinks of test rows must not
    shape them. Neighbourhoods survive in part, distances do not.

    Args:
        uplink: complex, of all rows.
        rows: (n,) to train on.
    """
    told = features(uplink).astype(np.float64)
    told = (told - told[rows].mean(axis=0)) / told[rows].std(axis=0).clip(1e-6)
    axes = np.linalg.svd(told[rows], full_matrices=False)[2][:3]
    parts = told @ axes.T
    return DEVIATION_M * parts / parts[rows].std(axis=0).clip(1e-6)


def features(uplink: np.ndarray) -> np.ndarray:
    """Return real features (S, F) float32 of uplinks (S, A, L) complex.

    Logarithmic power, correlations between antennas (directions), between tones (delays up to one common
    delay, of which only the modulus is kept), and the logarithmic power of each antenna relative to all.
    """
    power = (np.abs(uplink) ** 2).mean((1, 2)) + FLOOR
    unit = uplink / np.sqrt(power)[:, None, None]
    first, second = np.triu_indices(uplink.shape[1], 1)
    if len(first) > ANTENNA_PAIRS:
        keep = np.sort(np.random.default_rng(0).permutation(len(first))[:ANTENNA_PAIRS])
        first, second = first[keep], second[keep]
    across = np.einsum("spl,spl->sp", unit[:, first], unit[:, second].conj()) / uplink.shape[2]
    lags = range(1, uplink.shape[2] // 2 + 1)
    along = np.stack([(unit[..., lag:] * unit[..., :-lag].conj()).mean((1, 2)) for lag in lags], axis=1)
    # A timing error turns lag l by l times one angle: relative to lag 1 the shape of the profile is left.
    turn = np.angle(along[:, :1])
    along = along * np.exp(-1j * turn * np.arange(1, along.shape[1] + 1))
    each = np.log10((np.abs(unit) ** 2).mean(2) + 1e-3)
    parts = [np.log10(power)[:, None], across.real, across.imag, along.real, along.imag, each]
    return np.concatenate(parts, axis=1).astype(np.float32)

"""Pseudo-positions of snapshots: principal components of features of their uplinks."""

from __future__ import annotations

import numpy as np

from gsparc.processes.few_rows import sample_row_numbers

# Four deviations of the first coordinate, so that lengths are of the order of metres
SIZE_M = 100.0


def encode_positions(uplink: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return pseudo-positions (S, 3) float64 [m] of uplinks (S, A, L) complex,
    learned from rows (n,) alone.

    Neighbours in the features' three principal directions are neighbours;
    distances are not the truth's.
    """
    from sklearn.decomposition import PCA  # here, as it takes a second

    # As they are: scaled to one deviation, what is mostly noise would count like the logarithmic
    # power.
    inputs = features(uplink).astype(np.float64)
    code = PCA(3, svd_solver="full").fit(inputs[rows])
    return np.asarray(code.transform(inputs) * (SIZE_M / 4 / np.sqrt(code.explained_variance_[0])))


ANTENNA_PAIRS = 64  # pairs of antennas that are compared, at most; drawn with a fixed seed
FLOOR = 1e-12


def features(uplink: np.ndarray) -> np.ndarray:
    """Return real features (S, F) float32 of uplinks (S, A, L) complex.

    Logarithmic power, correlations between antennas (directions), between tones (delays up to one
    common delay, of which only the modulus is kept),
    and the logarithmic power of each antenna relative to all.
    """
    power = (np.abs(uplink) ** 2).mean((1, 2)) + FLOOR
    unit = uplink / np.sqrt(power)[:, None, None]
    first, second = _pairs(uplink.shape[1])
    across = np.einsum("spl,spl->sp", unit[:, first], unit[:, second].conj()) / uplink.shape[2]
    lags = range(1, uplink.shape[2] // 2 + 1)
    along = np.stack(
        [(unit[..., lag:] * unit[..., :-lag].conj()).mean((1, 2)) for lag in lags], axis=1
    )
    # A timing error turns lag l by l times one angle:
    # relative to lag 1 the shape of the profile is left.
    turn = np.angle(along[:, :1])
    along = along * np.exp(-1j * turn * np.arange(1, along.shape[1] + 1))
    each = np.log10((np.abs(unit) ** 2).mean(2) + 1e-3)
    parts = [
        10 * np.log10(power)[:, None] / 10,
        across.real,
        across.imag,
        along.real,
        along.imag,
        each,
    ]
    return np.concatenate(parts, axis=1).astype(np.float32)


def _pairs(antennas: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.triu_indices(antennas, 1)
    if len(first) > ANTENNA_PAIRS:
        keep = sample_row_numbers(len(first), ANTENNA_PAIRS, 0)
        first, second = first[keep], second[keep]
    return first, second

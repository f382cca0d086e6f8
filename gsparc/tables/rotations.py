"""Rotations as files state them: quaternions and matrices."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

UNIT_TOLERANCE = 1e-2  # releases print quaternions with few digits; beyond this they are refused


def is_unit(quaternion: np.ndarray) -> np.ndarray:
    """Tell whether quaternions (..., 4) are finite, of length 1 within `UNIT_TOLERANCE`: (...)
    bool.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return np.abs(np.linalg.norm(quaternion, axis=-1) - 1) <= UNIT_TOLERANCE


def quaternion_to_matrix(quaternion: np.ndarray, *, scalar_first: bool) -> np.ndarray:
    """Return rotation matrices (..., 3, 3), local to world, of quaternions (..., 4) of length 1."""
    # SciPy expects the scalar last and normalises, which removes the rounding of printed digits.
    q = np.roll(quaternion, -1, axis=-1) if scalar_first else quaternion
    return Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)


def is_rotation(matrix: np.ndarray, tolerance: float = 1e-3) -> np.ndarray:
    """Tell whether matrices (..., 3, 3) are orthogonal with determinant +1: (...) bool."""
    # Products of huge or missing numbers are refused below, so that NumPy need not warn.
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(axis=(-1, -2))
        return (error <= tolerance) & (np.linalg.det(matrix) > 0)

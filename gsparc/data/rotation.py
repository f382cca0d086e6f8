"""Quaternions of data files as rotation matrices, local to world."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

UNIT_TOLERANCE = 1e-2  # releases print quaternions with few digits; beyond this they are refused


def is_unit(quaternion: np.ndarray) -> np.ndarray:
    """Whether quaternions (..., 4) are finite and of length 1 within `UNIT_TOLERANCE`: (...) bool."""
    return np.abs(_length(quaternion) - 1) <= UNIT_TOLERANCE


def _length(quaternion: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.linalg.norm(quaternion, axis=-1)


def quaternion_to_matrix(quaternion: np.ndarray, *, scalar_first: bool) -> np.ndarray:
    """Rotation matrices (..., 3, 3), local to world, of quaternions (..., 4).

    Raises:
        ValueError: a quaternion is not finite or its length differs from 1 by more than 1 %.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    if not is_unit(q).all():
        order = "w, x, y, z" if scalar_first else "x, y, z, w"
        raise ValueError(f"expected a quaternion ({order}) of length 1, got length {_length(q)!s}")
    if scalar_first:
        q = np.roll(q, -1, axis=-1)
    return Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)


def is_rotation(matrix: np.ndarray, tolerance: float = 1e-3) -> np.ndarray:
    """Whether matrices (..., 3, 3) are orthogonal with determinant +1: (...) bool."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    good = np.isfinite(matrix).all(axis=(-1, -2)) & (error <= tolerance)
    # det only where finite: LAPACK complains about NaN
    determinant = np.linalg.det(np.where(good[..., None, None], matrix, np.eye(3)))
    return good & (determinant > 0)

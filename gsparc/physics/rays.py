"""Geometry of rays: where two of them pass each other."""

from __future__ import annotations

import numpy as np

MIN_ANGLE = 0.02  # [rad]: more parallel rays have no well-defined crossing


def closest_ranges_and_gap(
    first: np.ndarray, first_rays: np.ndarray, second: np.ndarray, second_rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the closest points of every pair of rays from two places.

    >>> x, y = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    >>> ranges = closest_ranges_and_gap(np.zeros(3), x, np.array([2.0, -1.0, 0.0]), y)

    2 m along the one, 1 m along the other, where they meet:

    >>> [float(one[0, 0]) for one in ranges]
    [2.0, 1.0, 0.0]

    Args:
        first, second: (3,) [m].
        first_rays, second_rays: (P, 3) and (Q, 3) unit vectors.

    Returns:
        Ranges (P, Q) [m] along the rays of both places, and the distance (P, Q) [m] between the
        rays there: infinite behind a place and between nearly parallel rays.
    """
    offset, cosine = second - first, first_rays @ second_rays.T
    a, b = (first_rays @ offset)[:, None], (second_rays @ offset)[None, :]
    sine2 = np.maximum(1 - cosine**2, MIN_ANGLE**2)
    # Least squares in both ranges: a system of two whose determinant is the squared sine of the
    # angle.
    s, t = (a - cosine * b) / sine2, (cosine * a - b) / sine2
    between = offset + t[..., None] * second_rays[None] - s[..., None] * first_rays[:, None]
    gap = np.linalg.norm(between, axis=-1)
    return s, t, np.where((s > 0) & (t > 0) & (1 - cosine**2 > MIN_ANGLE**2), gap, np.inf)

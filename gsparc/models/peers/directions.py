"""Virtual transmitters from directions of arrival, and directions where none were measured."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.physics.rays import closest_approach

MISS = 0.01  # [m], two rays that pass this close to each other meet
MERGE = 0.05  # [m], meeting points this close are one virtual transmitter
LEAST = 5  # meeting points of a virtual transmitter: fewer meet by chance
NEIGHBOURS = 8  # receivers whose rays are intersected with those of one receiver


def virtual_transmitters(places: np.ndarray, rays: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Points where rays of several receivers meet, and which of them every receiver sees.

    Args:
        places: (n, 3) [m].
        rays: n arrays (paths, 3) of unit vectors in the frame of the places.

    Returns:
        (V, 3) [m], and n arrays of rows of it, one entry per ray (-1: the ray passes none).
    """
    near = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(places)))[1]
    points = []
    for i, row in enumerate(np.atleast_2d(near)):
        meetings = [np.full((len(rays[i]), 1), np.nan)]
        for j in row[row != i]:
            along, _, miss = closest_approach(places[i], rays[i], places[j], rays[j])
            meetings.append(np.where(miss < MISS, along, np.nan))
        known = np.ma.masked_invalid(np.concatenate(meetings, 1))
        distance = np.ma.median(known, axis=1).filled(np.nan)
        points.append(places[i] + distance[:, None] * rays[i])  # NaN where a ray meets no other
    flat = np.concatenate(points) if points else np.zeros((0, 3))
    centres = _merged(flat[np.isfinite(flat[:, 0])])
    return centres, [_passed(place, own, centres) for place, own in zip(places, rays, strict=True)]


def _passed(place: np.ndarray, rays: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Row (paths,) of the centre that each ray comes nearest to, within the width of a cluster; -1: none."""
    if not len(centres):
        return np.full(len(rays), -1)
    offset = centres - place
    along = (rays @ offset.T).clip(min=0)
    miss = np.linalg.norm(offset - along[..., None] * rays[:, None], axis=-1)
    return np.where(miss.min(1) < 2 * MERGE, miss.argmin(1), -1)


def _merged(points: np.ndarray) -> np.ndarray:
    """Centres (V, 3) of greedy clusters of radius MERGE, the densest first, of at least LEAST points.

    Where none has as many, of the largest.
    """
    if not len(points):
        return np.zeros((0, 3))
    free = np.full(len(points), True)
    around = cKDTree(points).query_ball_point(points, MERGE)
    clusters = []
    for seed in sorted(range(len(points)), key=lambda k: -len(around[k])):
        if free[seed]:
            clusters.append([k for k in around[seed] if free[k]])
            free[clusters[-1]] = False
    least = min(LEAST, max(map(len, clusters)))
    return np.stack([np.median(points[rows], axis=0) for rows in clusters if len(rows) >= least])


def votes(seen: list[np.ndarray], count: int) -> Tensor:
    """How many rays of each receiver point at each virtual transmitter: (n, V) float32."""
    table = np.stack([np.bincount(rows[rows >= 0], minlength=count) for rows in seen])
    return torch.from_numpy(table.astype(np.float32))

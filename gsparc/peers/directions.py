"""Virtual transmitters from directions of arrival, and directions where none were measured."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.physics.rays import closest_approach

MISS = 0.01  # [m], two rays that pass this close to each other meet
MERGE = 0.05  # [m], meeting points this close are one virtual transmitter
NEIGHBOURS = 8  # receivers whose rays are intersected with those of one receiver


def virtual_transmitters(places: np.ndarray, rays: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Points where rays of several receivers meet, and which of them every receiver sees.

    Args:
        places: (n, 3) [m].
        rays: n arrays (paths, 3) of unit vectors in the frame of the places.

    Returns:
        (V, 3) [m], and n arrays of rows of it, one entry per ray (-1: the ray meets no other).
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
    owner = np.repeat(np.arange(len(points)), [len(p) for p in points])
    flat = np.concatenate(points) if points else np.zeros((0, 3))
    met = np.isfinite(flat[:, 0])
    centres, labels = _merged(flat[met])
    rows = np.full(len(flat), -1)
    rows[met] = labels
    return centres, [rows[owner == i] for i in range(len(points))]


def _merged(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Greedy clusters of radius MERGE, the densest first: centres (V, 3) and the label of every point."""
    labels = np.full(len(points), -1)
    if not len(points):
        return np.zeros((0, 3)), labels
    tree = cKDTree(points)
    around = tree.query_ball_point(points, MERGE)
    centres: list[np.ndarray] = []
    for seed in sorted(range(len(points)), key=lambda k: -len(around[k])):
        if labels[seed] >= 0:
            continue
        members = [k for k in around[seed] if labels[k] < 0]
        labels[members] = len(centres)
        centres.append(np.median(points[members], axis=0))
    return np.stack(centres), labels


def votes(seen: list[np.ndarray], count: int) -> Tensor:
    """How many rays of each receiver point at each virtual transmitter: (n, V) float32."""
    table = np.stack([np.bincount(rows[rows >= 0], minlength=count) for rows in seen])
    return torch.from_numpy(table.astype(np.float32))

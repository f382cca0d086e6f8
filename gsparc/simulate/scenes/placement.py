"""Receiver positions: over the floor, outside objects, reproducible by seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from gsparc.simulate.scenes.solid import Solid

TRIES = 200  # draws for each place, of which one is to be allowed
DRAWN = 1024  # at a time


def place(
    count: int,
    area: np.ndarray,
    height: Sequence[float],
    allowed: Callable[[np.ndarray], np.ndarray],
    seed: int,
) -> np.ndarray:
    """`count` positions (S, 3) float64 [m], uniform over an area where `allowed` is True.

    Args:
        count: how many.
        area: (2, 2) [m] lower and upper corner in x and y.
        height: lowest and highest z [m].
        allowed: (N, 3) -> (N,) bool.
        seed: of the draw; a larger count begins with the positions of a smaller one.

    Raises:
        ValueError: almost nowhere is allowed.
    """
    low, high = (np.array([*area[i], end(height)], dtype=float) for i, end in enumerate((min, max)))
    if not (np.isfinite([low, high]).all() and (high >= low).all() and (high > low)[:2].all()):
        raise ValueError(f"scene.area_m, scene.height_m: expected lower below upper, got {low} and {high}")
    rng = np.random.default_rng(seed)
    found = np.empty((0, 3))
    for _ in range(TRIES * -(-count // DRAWN)):
        drawn = rng.uniform(low, high, size=(DRAWN, 3))
        found = np.concatenate([found, drawn[allowed(drawn)]])
        if len(found) >= count:
            return found[:count]
    fit = f"only {len(found)} of {count} receivers fit into scene.area_m"
    raise ValueError(f"scene: {fit}; is it inside a building?")


def clear_of(solids: Sequence[Solid], margin: float = 0.05) -> Callable[[np.ndarray], np.ndarray]:
    """A test of places (n, 3) [m]: which (n,) stand `margin` [m] away from all boxes and off all sheets."""
    boxes = np.array([s.keep_out for s in solids if s.keep_out is not None]).reshape(-1, 2, 3)
    walls = [s.vertices for s in solids if s.keep_out is None]

    def allowed(points: np.ndarray) -> np.ndarray:
        free = np.ones(len(points), dtype=bool)
        for low, high in boxes:
            free &= ~np.all((points >= low - margin) & (points <= high + margin), axis=1)
        for corners in walls:
            normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
            normal /= np.linalg.norm(normal)
            near = np.abs((points - corners[0]) @ normal) < margin
            low, high = corners.min(0) - margin, corners.max(0) + margin
            free &= ~(near & np.all((points >= low) & (points <= high), axis=1))
        return free

    return allowed


def spread(positions: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Rows (count,) of positions far apart: farthest-point order from a seeded start."""
    count = min(count, len(positions))
    chosen = [int(np.random.default_rng(seed).integers(len(positions)))]
    distance = np.linalg.norm(positions - positions[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return np.array(chosen)


def neighbours(positions: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The nearest other row of each of `rows`."""
    return cKDTree(positions).query(positions[rows], k=2)[1][:, 1]

"""Boxes and sheets of a scene built in code: triangles with an ITU material;
triangles as a file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gsparc.base.files import read_shipped_table, write_whole

LISTED_MATERIALS = read_shipped_table(__package__, "materials.csv")
MILLIMETRES = 3  # digits of a corner in a file


@dataclass(frozen=True)
class Solid:
    """One object of a scene.

    Attributes:
        name: unique in the scene.
        material: an ITU-R P.2040 name (`concrete`, `glass`, ...).
        vertices: (V, 3) [m].
        faces: (F, 3) vertex numbers.
        keep_out: (2, 3) [m] lower and upper corner where no receiver may stand; None for sheets.
    """

    name: str
    material: str
    vertices: np.ndarray
    faces: np.ndarray
    keep_out: np.ndarray | None = None


def sheet(
    name: str, material: str, corner: ArrayLike, first: ArrayLike, second: ArrayLike
) -> Solid:
    """Build a parallelogram from `corner` along two sides (3,) [m].

    >>> sheet("floor", "concrete", (0, 0, 0), (4, 0, 0), (0, 3, 0)).vertices[2].tolist()
    [4.0, 3.0, 0.0]
    """
    start, a, b = (np.asarray(v, dtype=np.float64) for v in (corner, first, second))
    vertices = np.stack([start, start + a, start + a + b, start + b])
    return Solid(name, material, vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def box(name: str, material: str, lower: ArrayLike, upper: ArrayLike, turn: float = 0.0) -> Solid:
    """Build a box between corners (3,) [m], turned upright by `turn` [rad]; faces look outwards.

    >>> box("table", "wood", (0, 0, 0.7), (2, 1, 0.74)).faces.shape  # two triangles a side
    (12, 3)
    """
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    unit = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
    offset = (unit - 0.5) * (high - low)
    cosine, sine = np.cos(turn), np.sin(turn)
    # Corners are rows: this is the transpose of the rotation by `turn`.
    offset[:, :2] = offset[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    faces = np.array(
        [
            [0, 2, 1],
            [1, 2, 3],
            [4, 5, 6],
            [5, 7, 6],
            [0, 1, 4],
            [1, 5, 4],
            [2, 6, 3],
            [3, 6, 7],
            [0, 4, 2],
            [2, 4, 6],
            [1, 3, 5],
            [3, 7, 5],
        ]
    )
    vertices = (low + high) / 2 + offset
    return Solid(name, material, vertices, faces, np.stack([vertices.min(0), vertices.max(0)]))


def write_walls(triangles: np.ndarray, path: Path) -> None:
    """Write triangles (n, 3, 3) [m], world, for `init=scene`, whole or not at all;
    none without area.
    """
    lines = [f"- {corners}" for corners in np.round(triangles, MILLIMETRES).tolist()]
    write_whole(path, "\n".join(["walls:", *lines, ""]))

"""Triangles of a scene as a mesh that `init=scene` and other programs read (Wavefront OBJ)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.data.files import whole_file

MILLIMETRES = 3  # digits of a corner


def write_mesh(triangles: np.ndarray, path: Path) -> None:
    """Write triangles (n, 3, 3) [m], world, whole or not at all; equal corners are one vertex."""
    corners, which = np.unique(np.round(triangles.reshape(-1, 3), MILLIMETRES), axis=0, return_inverse=True)
    vertices = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in corners]
    faces = [f"f {a} {b} {c}" for a, b, c in which.reshape(-1, 3) + 1]
    with whole_file(path) as partial:
        partial.write_text("\n".join([*vertices, *faces, ""]), encoding="utf-8")

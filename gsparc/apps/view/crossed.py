"""What stands on the straight line between two places: known walls, and boxes that were found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsparc.data.walls import SceneWalls

APART_M = 0.5  # faces that are nearer to each other along a line are sides of one wall [m]


@dataclass(frozen=True)
class Obstacles:
    """Faces as triangles, and boxes.

    Attributes:
        triangles: (T, 3, 3) corners [m], each face a fan about its first corner.
        face: (T,) of which face each is.
        boxes: (B, 2, 3) lower and upper corners [m].
    """

    triangles: np.ndarray
    face: np.ndarray
    boxes: np.ndarray

    @classmethod
    def of(cls, walls: SceneWalls) -> Obstacles:
        """Return what is known of a scene."""
        count = np.array([len(face) - 2 for face in walls.faces], np.int64)
        return cls(fans(walls.faces), np.repeat(np.arange(len(count)), count), walls.boxes)

    def crossed(self, start: np.ndarray, end: np.ndarray) -> int:
        """Walls and boxes that the line between two places (3,) [m] passes; both sides of one count once."""
        along = end - start
        length = float(np.linalg.norm(along))
        if length == 0:
            return 0
        at = np.sort(np.concatenate([self._faces(start, along), self._boxes(start, along)])) * length
        return int(len(at) > 0) + int((np.diff(at) > APART_M).sum())

    def _faces(self, start: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Shares of the line (n,) at which faces are crossed. Moeller and Trumbore 1997, equation 4."""
        corner = self.triangles[:, 0]
        one, two = self.triangles[:, 1] - corner, self.triangles[:, 2] - corner
        across = np.cross(along, two)
        determinant = (across * one).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ((start - corner) * across).sum(1) / determinant
            turned = np.cross(start - corner, one)
            v = (turned @ along) / determinant
            share = (turned * two).sum(1) / determinant
            # Half open, so that the edge two triangles of a fan share belongs to one of them.
            hit = (u >= 0) & (v > 0) & (u + v <= 1) & (share > 0) & (share < 1)
        _, first, times = np.unique(self.face[hit], return_index=True, return_counts=True)
        return np.asarray(share[hit][first[times % 2 == 1]])  # a fan outside its face is crossed twice

    def _boxes(self, start: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Shares of the line (n,) at which boxes are entered, 0 of those in which it begins."""
        with np.errstate(divide="ignore", invalid="ignore"):
            edges = (self.boxes - start) / along
        enter, leave = np.nanmax(edges.min(1), axis=1), np.nanmin(edges.max(1), axis=1)
        hit = (np.maximum(enter, 0) < np.minimum(leave, 1)) & np.isfinite(leave)
        return np.asarray(np.maximum(enter, 0)[hit])


def fans(faces: Sequence[np.ndarray]) -> np.ndarray:
    """Triangles (T, 3, 3) of flat faces (C, 3), each a fan about its first corner."""
    triangles = [face[[0, i, i + 1]] for face in faces for i in range(1, len(face) - 1)]
    return np.array(triangles).reshape(-1, 3, 3)

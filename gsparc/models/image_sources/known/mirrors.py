"""Walls of a file as mirror planes, each with the rectangles on it that reflect and block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.walls import SceneWalls, area, box_faces, normal_of
from gsparc.models.image_sources.clutter.blocking import Clutter, tangents
from gsparc.processes.wall_count import Walls

PARALLEL = 0.99995  # cosine of normals of faces of one plane: half a degree
SAME_PLANE_M = 0.01  # [m], of a face's corners from the plane it is joined to
SAME_CORNER_M = 1e-3  # [m], of faces that touch
MOST_PATCHES = 300  # rectangles; of finer meshes the largest


@dataclass(frozen=True)
class Mirrors:
    """Planes and what is on them, in some frame.

    Attributes:
        planes: (P, 4) float64, unit normals and offsets [m].
        clutter: rectangles on the planes, and boxes.
        left_out: rectangles beyond `MOST_PATCHES`, the smallest.
    """

    planes: Tensor
    clutter: Clutter
    left_out: int = 0

    @staticmethod
    def of(walls: SceneWalls, origin: np.ndarray) -> Mirrors:
        """Faces of one plane are joined; those that touch each other make one rectangle around them.

        Args:
            walls: of a file.
            origin: (3,) float64 [m], of the frame in the file's coordinates.
        """
        faces = [face - origin for face in walls.faces]
        grouped = _by_plane(faces)
        planes = torch.from_numpy(np.array([plane for plane, _ in grouped]).reshape(-1, 4))
        patches: list[Tensor] = []
        indices: list[int] = []
        for number, (_, members) in enumerate(grouped):
            along = tangents(planes[number]).double()
            for part in _touching(members):
                ends = torch.from_numpy(part) @ along.T
                patches.append(torch.cat([ends.amin(0), ends.amax(0)]))
                indices.append(number)
        found = torch.stack(patches) if patches else torch.zeros(0, 4, dtype=torch.float64)
        size = (found[:, 2:] - found[:, :2]).prod(1)
        kept = size.topk(min(MOST_PATCHES, len(size))).indices.sort().values.tolist()
        boxes = torch.from_numpy((walls.boxes - origin).reshape(-1, 6)).float()
        plane = tuple(indices[i] for i in kept)
        return Mirrors(planes, Clutter(boxes, found[kept].float(), plane), len(found) - len(kept))

    def mirroring(self, smallest: float) -> list[int]:
        """Numbers of planes with a rectangle whose sides are at least so long [m], the largest first.

        Others only block.
        """
        sides = self.clutter.patches[:, 2:] - self.clutter.patches[:, :2]
        size: dict[int, float] = {}
        for plane, (one, other) in zip(self.clutter.plane, sides.tolist(), strict=True):
            if min(one, other) >= smallest:
                size[plane] = size.get(plane, 0.0) + one * other
        return sorted(size, key=lambda plane: -size[plane])


def counted(walls: SceneWalls, origin: np.ndarray, still: np.ndarray | None) -> Walls:
    """Walls and boxes of a file for paths to the end that stands (3,) local [m]; None: both move."""
    faces = [face for low, high in walls.boxes for face in box_faces(low, high)]
    known = Mirrors.of(SceneWalls((*walls.faces, *faces), walls.boxes[:0]), origin)
    planes, patches = known.planes[list(known.clutter.plane)], known.clutter.patches.double()
    axes = torch.stack([torch.cat([plane[None, :3], tangents(plane).double()]) for plane in planes])
    corners = torch.cat([planes[:, 3:], patches[:, :2]], 1)
    return Walls(
        axes,
        corners,
        patches[:, 2:] - patches[:, :2],
        torch.from_numpy(np.zeros(0) if still is None else still).double(),
    )


def _by_plane(faces: list[np.ndarray]) -> list[tuple[np.ndarray, list[np.ndarray]]]:
    """Planes (4,) and the faces on each; the largest face gives the plane."""
    found: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for face in sorted(faces, key=area, reverse=True):
        normal = normal_of(face)
        normal = normal / np.linalg.norm(normal)
        for plane, members in found:
            apart = np.abs(face @ plane[:3] - plane[3]).max()
            if abs(float(normal @ plane[:3])) > PARALLEL and apart < SAME_PLANE_M:
                members.append(face)
                break
        else:
            found.append((np.append(normal, normal @ face.mean(0)), [face]))
    return found


def _touching(faces: list[np.ndarray]) -> list[np.ndarray]:
    """Corners (C, 3) of each group of faces that share corners."""
    groups: list[tuple[set[tuple[int, ...]], list[np.ndarray]]] = []
    for face in faces:
        corners = {tuple(c) for c in np.round(face / SAME_CORNER_M).astype(np.int64).tolist()}
        parts = [face]
        apart = []
        for known, members in groups:
            if known & corners:
                corners, parts = corners | known, parts + members
            else:
                apart.append((known, members))
        groups = [*apart, (corners, parts)]
    return [np.concatenate(parts) for _, parts in groups]

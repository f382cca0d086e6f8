"""Walls of a file as mirrors, and images of the static end that some receiver sees,
strongest first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from gsparc.data.walls import SceneWalls, box_faces, polygon_area, polygon_normal
from gsparc.models.apart import keep_apart
from gsparc.models.image_sources.clutter.blocking import (
    PATCH,
    Clutter,
    plane_tangents,
    visible_share,
)
from gsparc.models.image_sources.clutter.unfold import SAME_M, Legs, Unfolding
from gsparc.physics.mirror_planes import NO_PLANES, Reflections, all_sequences, hesse_form, images
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.trend import Walls

REFLECTED = 0.6  # amplitude that a reflection leaves, of building materials
# Sequences of walls of each length that are looked at, over the largest of them
MOST_SEQUENCES = 3_000
LOOKED_FROM = 100  # places
AT_ONCE = 50  # sequences whose paths are held together: memory
SHORTLIST = 4  # times as many as are wanted, before what walls hide is looked at
SEEN = 1e-3  # mean share of an image that is kept
HIDES = 0.01  # share of one image that a rectangle takes, to be kept


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
    def from_walls(walls: SceneWalls, origin: np.ndarray) -> Mirrors:
        """Join faces of one plane; those that touch each other make one rectangle around them.

        Args:
            walls: of a file.
            origin: (3,) float64 [m], of the frame in the file's coordinates.
        """
        faces = [face - origin for face in walls.faces]
        grouped = _group_by_plane(faces)
        planes = torch.cat([NO_PLANES, *(torch.from_numpy(plane)[None] for plane, _ in grouped)])
        patches: list[Tensor] = []
        indices: list[int] = []
        for number, (_, members) in enumerate(grouped):
            along = plane_tangents(planes[number]).double()
            for part in _join_touching(members):
                ends = torch.from_numpy(part) @ along.T
                patches.append(torch.cat([ends.amin(0), ends.amax(0)]))
                indices.append(number)
        rectangles = torch.stack(patches) if patches else torch.zeros(0, PATCH).double()
        size = _side_lengths(rectangles).prod(1)
        top = size.topk(min(MOST_PATCHES, len(size))).indices.sort().values.tolist()
        boxes = torch.from_numpy(walls.boxes - origin).flatten(1).float()
        plane = tuple(indices[i] for i in top)
        return Mirrors(
            planes, Clutter(boxes, rectangles[top].float(), plane), len(rectangles) - len(top)
        )

    def large_planes(self, smallest: float) -> list[int]:
        """Return numbers of planes with a rectangle whose sides are at least so long [m],
        the largest first.

        Others only block.
        """
        sides = _side_lengths(self.clutter.patches)
        size: dict[int, float] = {}
        for plane, (width, height) in zip(self.clutter.plane, sides.tolist(), strict=True):
            if min(width, height) >= smallest:
                size[plane] = size.get(plane, 0.0) + width * height
        return sorted(size, key=lambda plane: -size[plane])

    def paths(self, sequences: Sequence[Reflections], transmitter: Tensor, places: Tensor) -> Legs:
        """Return the paths from places (n, 3) to the transmitter (3,) float64 [m]."""
        return Unfolding(transmitter, self.planes, tuple(sequences)).paths(places)

    def visible_sequences(
        self,
        indices: list[int],
        transmitter: Tensor,
        places: Tensor,
        order: int,
        limit: int,
        hidden: bool,
    ) -> tuple[Reflections, ...]:
        """Return at most `limit` sequences, the static end's own first,
        then by power expected at the places.

        Args:
            indices: planes that mirror, the largest first.
            transmitter: (3,) float64 [m].
            places: (n, 3) float64 [m] of receivers.
            order: largest number of reflections.
            limit: sequences.
            hidden: whether walls end and hide; else every image is seen from everywhere.
        """
        places = places[evenly_spaced(len(places), LOOKED_FROM)]
        candidates = [
            sequence
            for length in range(1, order + 1)
            for sequence in all_sequences(indices[: limit_mirrors(len(indices), length)], length)
            if len(sequence) == length
        ]
        sequences = _drop_doubles(candidates, transmitter, self.planes)
        if not sequences or limit < 2:
            return ((),)

        def evaluate_parts(evaluate: Callable[..., Tensor], numbers: Tensor) -> Tensor:
            """Return what is said of some sequences."""
            parts = ([sequences[i] for i in part.tolist()] for part in numbers.split(AT_ONCE))
            return torch.cat([evaluate(part, transmitter, places, hidden) for part in parts])

        scores = evaluate_parts(self._expected_powers, torch.arange(len(sequences)))
        best = scores.topk(min(SHORTLIST * limit, len(sequences))).indices
        best = best[scores[best] > 0]
        if hidden and len(best):
            seen = evaluate_parts(self._mean_visible_shares, best)
            best, power = best[seen > SEEN], (scores[best] * seen)[seen > SEEN]
            best = best[power.argsort(descending=True)]
        return ((), *(sequences[i] for i in best[: limit - 1].tolist()))

    def obstacles_of(
        self, sequences: tuple[Reflections, ...], transmitter: Tensor, places: Tensor
    ) -> Clutter:
        """Return the rectangles that mirror sequences or that hide one from a place,
        and the boxes.
        """
        clutter, paths = self.clutter, self.paths(sequences, transmitter, places)
        used = {index for sequence in sequences for index in sequence}
        numbers = []
        for number, plane in enumerate(clutter.plane):
            patch = Clutter(clutter.boxes[:0], clutter.patches[number : number + 1], (plane,))
            shadow = 1 - visible_share(paths, patch, self.planes)
            if plane in used or float(shadow.max()) > HIDES:
                numbers.append(number)
        planes = tuple(clutter.plane[i] for i in numbers)
        return replace(clutter, patches=clutter.patches[numbers], plane=planes)

    def _expected_powers(
        self, sequences: list[Reflections], transmitter: Tensor, places: Tensor, hidden: bool
    ) -> Tensor:
        """Expected power (W,) of sequences over that of 1 m, where rectangles reflect them;
        nothing hides.
        """
        # [m]: a place at an image would outweigh all others.
        away = torch.cdist(images(transmitter, self.planes, sequences), places).clamp_min(0.1)
        order = torch.tensor([len(sequence) for sequence in sequences])
        power = away.square().reciprocal()
        if hidden:
            power = power * self._are_reflected(self.paths(sequences, transmitter, places))
        return power.mean(1) * REFLECTED ** (2 * order)

    def _are_reflected(self, paths: Legs) -> Tensor:
        """Whether (W, n) every leg of a sequence ends on a rectangle of its plane, as 0 and 1."""
        inside = paths.plane < 0
        for patch, plane in zip(self.clutter.patches, self.clutter.plane, strict=True):
            reflected = paths.plane == plane
            if bool(reflected.any()):
                met = paths.end[reflected] @ plane_tangents(self.planes[plane]).T
                inside[reflected] |= ((met >= patch[:2]) & (met <= patch[2:])).all(1)
        return (inside.all(-1) & paths.valid).float()

    def _mean_visible_shares(self, sequences: list[Reflections], *ends: Tensor) -> Tensor:
        """Mean visible share (W,) of sequences, walls and boxes in the way included."""
        return visible_share(self.paths(sequences, *ends[:2]), self.clutter, self.planes).mean(1)


def walls_in_frame(walls: SceneWalls, origin: np.ndarray, still: np.ndarray | None) -> Walls:
    """Return walls and boxes of a file for paths to an end that is `still` (3,), local [m]; None:
    both move.
    """
    faces = [face for low, high in walls.boxes for face in box_faces(low, high)]
    mirrors = Mirrors.from_walls(SceneWalls((*walls.faces, *faces), walls.boxes[:0]), origin)
    planes, patches = mirrors.planes[list(mirrors.clutter.plane)], mirrors.clutter.patches.double()
    normal, offset = hesse_form(planes)
    axes = torch.cat([normal[None], plane_tangents(planes).double()]).movedim(0, 1)
    corners = torch.cat([offset, patches.chunk(2, 1)[0]], 1)
    end = torch.from_numpy(np.zeros(0) if still is None else still).double()
    return Walls(axes, corners, _side_lengths(patches), end)


def _side_lengths(patches: Tensor) -> Tensor:
    """Lengths (Q, 2) [m] of patches (Q, 4)."""
    low, high = patches.chunk(2, 1)
    return high - low


def _group_by_plane(faces: list[np.ndarray]) -> list[tuple[np.ndarray, list[np.ndarray]]]:
    """Planes (4,) and the faces on each; the largest face gives the plane."""
    planes: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for face in sorted(faces, key=polygon_area, reverse=True):
        normal = polygon_normal(face)
        normal = normal / np.linalg.norm(normal)
        for (*other, offset), members in planes:
            distance = np.abs(face @ other - offset).max()
            if abs(float(normal @ other)) > PARALLEL and distance < SAME_PLANE_M:
                members.append(face)
                break
        else:
            planes.append((np.append(normal, normal @ face.mean(0)), [face]))
    return planes


def _join_touching(faces: list[np.ndarray]) -> list[np.ndarray]:
    """Corners (C, 3) of each group of faces that share corners."""
    face = np.repeat(np.arange(len(faces)), [len(corners) for corners in faces])
    corners = np.concatenate(faces)
    corner = np.unique(
        np.round(corners / SAME_CORNER_M).astype(np.int64), axis=0, return_inverse=True
    )[1]
    shared = coo_array((np.ones(len(face)), (face, corner.reshape(-1)))).tocsr()
    count, group = connected_components(shared @ shared.T, directed=False)
    return [corners[group[face] == number] for number in range(count)]


def limit_mirrors(mirrors: int, length: int) -> int:
    """Return how many of `mirrors` have at most `MOST_SEQUENCES` sequences
    of so many reflections.
    """
    count = mirrors
    while count > 1 and count * (count - 1) ** (length - 1) > MOST_SEQUENCES:
        count -= 1
    return count


def _drop_doubles(
    sequences: list[Reflections], transmitter: Tensor, planes: Tensor
) -> list[Reflections]:
    """One sequence of each image: perpendicular mirrors have the same in both orders."""
    if not sequences:
        return []
    places = images(transmitter, planes, sequences)
    distinct: list[int] = []
    numbers = sorted(range(len(sequences)), key=lambda i: (len(sequences[i]), sorted(sequences[i])))
    for _, group in groupby(numbers, key=lambda i: sorted(sequences[i])):
        distinct += keep_apart(group, lambda i, j: float((places[i] - places[j]).norm()) <= SAME_M)
    return [sequences[i] for i in sorted(distinct)]


def starting_log_amplitudes(sequences: tuple[Reflections, ...], direct_amplitude: float) -> Tensor:
    """Return log amplitudes (K,) float32 to start from, given the direct wave's amplitude."""
    order = torch.tensor([float(len(sequence)) for sequence in sequences])
    return math.log(direct_amplitude) + order * math.log(REFLECTED)

"""Unfold reflection sequences into straight legs of paths,
from receiver to transmitter (image method).

The path of sequence (i, j) leaves the receiver towards the image of the whole sequence, meets plane
j there, continues towards the image of (i,), and so on. Of perpendicular mirrors both orders have
the same image; which of them a receiver sees follows from where the line
to the image meets the planes first.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, permutations

import torch
from torch import Tensor

from gsparc.physics.mirror_planes import Reflections, hesse_form, images, reflect

SAME_M = 0.05  # [m], sequences of the same planes whose images are closer are the same source
# Tolerance of the intersection of a leg with a plane, and [m] least side of a leg's box
EDGE = 1e-6
PARALLEL = 1e-9  # [m], difference of heights over a plane that legs along it are given


@dataclass(frozen=True)
class Legs:
    """Legs of K sequences from n places.

    Attributes:
        points: (K, n, L + 1, 3) float32 [m], place, reflections, transmitter; sequences shorter
            than L - 1 are padded with legs of no length.
        plane: (K, n, L) plane met at the end of each leg, -1 for none.
        valid: (K, n) bool, whether the sequence's planes are met in order between receiver and
            image.
    """

    points: Tensor
    plane: Tensor
    valid: Tensor

    @property
    def start(self) -> Tensor:
        """(K, n, L, 3) of each leg [m]."""
        return self.points[:, :, :-1]

    @property
    def end(self) -> Tensor:
        """(K, n, L, 3) of each leg [m]."""
        return self.points[:, :, 1:]

    def select_sequences(self, sequences: Tensor | list[int]) -> Legs:
        """Return the paths of some sequences."""
        return Legs(self.points[sequences], self.plane[sequences], self.valid[sequences])


class Unfolding:
    """All orders of the planes of K sequences with the same image, prepared for unfolding.

    Args:
        transmitter: (3,) float64 [m].
        planes: (P, 4) float64.
        sequences: K of them.

    Attributes:
        chain: (L, K, M, 1, 3) float32 [m]; entry l is the image after l reflections.
        normal: (L - 1, K, M, 1, 3) float32 unit normals of the planes; zero beyond the sequence's
            end.
        offset: (L - 1, K, M, 1) float32 [m]; zero beyond.
        height: (L - 1, K, M, 1) float32 [m], of the image after the reflection over its plane; -1
            beyond, so that legs there have no length.
        plane: (K, M, 1, L) in the order in which a path meets them, -1 where there is none.
        present: (K, M, 1) bool, whether the entry exists.
    """

    def __init__(
        self, transmitter: Tensor, planes: Tensor, sequences: tuple[Reflections, ...]
    ) -> None:
        variants = _equivalent_sequences(transmitter, planes, sequences)
        most, order = max(map(len, variants)), max(map(len, sequences), default=0)
        plane = torch.full((order, len(sequences), most, 1), -1)
        self.present = torch.zeros(len(sequences), most, 1, dtype=torch.bool)
        for k, mine in enumerate(variants):
            for m, sequence in enumerate(mine):
                plane[: len(sequence), k, m, 0] = torch.tensor(sequence, dtype=torch.long)
                self.present[k, m] = True
        table = planes if len(planes) else torch.tensor([[1.0, 0, 0, 0]], dtype=planes.dtype)
        used, exists = table[plane.clamp_min(0)], plane >= 0
        chain = [transmitter.expand(*self.present.shape, -1)]
        for mirror, exist in zip(used, exists, strict=True):
            chain.append(torch.where(exist[..., None], reflect(chain[-1], mirror), chain[-1]))
        normal, offset = hesse_form(used)
        self.normal, self.chain = normal.float() * exists[..., None], torch.stack(chain).float()
        self.offset = offset[..., 0].float() * exists
        height = (self.chain[1:] * self.normal).sum(-1) - self.offset
        self.height = torch.where(exists, height, -1.0)
        self.plane = torch.cat([plane.flip(0), torch.full((1, *self.present.shape), -1)]).movedim(
            0, -1
        )

    def paths(self, places: Tensor) -> Legs:
        """Return the paths from places (n, 3) [m]."""
        shape = (*self.present.shape[:2], len(places))
        point, valid = places.to(self.chain.dtype).expand(*shape, 3), self.present.expand(shape)
        points = [point]
        steps = list(zip(self.normal, self.offset, self.height, self.chain[1:], strict=True))
        for normal, offset, height, image in reversed(steps):
            above = (point * normal).sum(-1) - offset
            share = above / (above - height + PARALLEL)
            valid = valid & ((share - 0.5).abs() < 0.5 + EDGE)
            point = torch.lerp(point, image, share.clamp(0, 1)[..., None])
            points.append(point)
        points.append(self.chain[0].expand_as(point))
        chosen = valid.int().argmax(1)  # the first valid variant, else the first
        plane = _select_variants(self.plane.expand(*shape, -1), chosen)
        return Legs(_select_variants(torch.stack(points, -2), chosen), plane, valid.any(1))


def _select_variants(values: Tensor, variants: Tensor) -> Tensor:
    """(K, M, n, ...) at variant `variants` (K, n)."""
    if values.shape[1] == 1:
        return values[:, 0]
    return values[torch.arange(len(values))[:, None], variants, torch.arange(values.shape[2])]


def _equivalent_sequences(
    transmitter: Tensor, planes: Tensor, sequences: tuple[Reflections, ...]
) -> list[list[Reflections]]:
    """Each sequence, then its permutations with the same image."""
    groups = []
    for sequence in sequences:
        others = [
            other
            for other in dict.fromkeys(permutations(sequence))
            if other != sequence and all(a != b for a, b in pairwise(other))
        ]
        if others:
            places = images(transmitter, planes, [sequence, *others])
            same = (places[1:] - places[0]).norm(dim=1) < SAME_M
            others = [other for other, alike in zip(others, same.tolist(), strict=True) if alike]
        groups.append([sequence, *others])
    return groups

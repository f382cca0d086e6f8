"""Occlusion of path legs by boxes and patches.

A box blocks legs with a chord of more than a few centimetres. A patch is a rectangle on a mirror
plane: a plane with patches reflects only inside them, and a patch blocks all other legs. Edges are
soft, so that they can be moved by gradients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.models.image_sources.clutter.unfold import EDGE, Legs
from gsparc.physics.mirror_planes import hesse_form

MARGIN = 0.03  # [m], chord that is not blocked: legs end on the faces that reflect them
# [m], width of a soft edge; a leg that ends nearer to a patch is reflected by it, not blocked
SOFT = 0.02
BOX, PATCH = 6, 4  # numbers of each: coordinates of two corners in space, on a plane


@dataclass(frozen=True)
class Clutter:
    """Boxes and patches of one scene, in its frame.

    Attributes:
        boxes: (B, 6) float32 [m], lower then upper corners.
        patches: (Q, 4) float32 [m], lower then upper corners along the plane's `plane_tangents`.
        plane: Q indices of planes of the scene.
    """

    boxes: Tensor
    patches: Tensor
    plane: tuple[int, ...]

    @staticmethod
    def empty() -> Clutter:
        """Return clutter of no boxes and infinite mirrors."""
        return Clutter(torch.zeros(0, BOX), torch.zeros(0, PATCH), ())

    def __len__(self) -> int:
        return len(self.boxes) + len(self.patches)

    def add_box(self, box: Tensor) -> Clutter:
        """Return it with one more box (6,)."""
        return replace(self, boxes=torch.cat([self.boxes, box[None]]))

    def add_patch(self, patch: Tensor, plane: int) -> Clutter:
        """Return it with one more patch (4,)."""
        patches = torch.cat([self.patches, patch[None]])
        return replace(self, patches=patches, plane=(*self.plane, plane))

    def remove_piece(self, number: int) -> Clutter:
        """Return it with one piece less; boxes count before patches."""
        boxes = [i for i in range(len(self.boxes)) if i != number]
        patches = [i for i in range(len(self.plane)) if i + len(self.boxes) != number]
        return Clutter(
            self.boxes[boxes], self.patches[patches], tuple(self.plane[i] for i in patches)
        )

    def renumber_planes(self, new: dict[int, int]) -> Clutter:
        """Return it with planes of new indices; patches of planes without one are dropped."""
        patches = [i for i, plane in enumerate(self.plane) if plane in new]
        return replace(
            self, patches=self.patches[patches], plane=tuple(new[self.plane[i]] for i in patches)
        )


def visible_share(paths: Legs, clutter: Clutter, planes: Tensor) -> Tensor:
    """Return the visible share (K, n) in [0, 1] of each source;
    differentiable in boxes and patches.
    """
    return Obstacles(clutter, planes).visible_share(paths)


class Obstacles:
    """Clutter of a scene, prepared for paths.

    Attributes:
        boxes: (B, 6).
        patches: (Q, 4).
        plane: (Q, 1, 1, 1) planes of the patches.
        axes: (3, Q, 3), normals and both tangents of these planes.
        offset: (Q, 1, 1, 1) of these planes.
        ends: (P + 1,) bool, which planes have patches; the last is no plane.
    """

    def __init__(self, clutter: Clutter, planes: Tensor) -> None:
        plane = torch.tensor(clutter.plane, dtype=torch.long)
        self.ends = torch.zeros(len(planes) + 1, dtype=torch.bool)
        self.ends[plane] = True
        used, self.boxes, self.patches = planes[plane], clutter.boxes, clutter.patches
        normal, offset = (part.float() for part in hesse_form(used))
        self.plane, self.offset = plane.view(-1, 1, 1, 1), offset.view(-1, 1, 1, 1)
        self.axes = torch.cat([normal[None], plane_tangents(used)])

    def visible_share(self, paths: Legs) -> Tensor:
        """Return the visible share (K, n) in [0, 1] of each source."""
        seen = torch.ones(paths.valid.shape)
        if len(self.boxes):
            seen = seen * share_past_boxes(paths, self.boxes).prod(0)
        if len(self.patches):
            seen = seen * self._share_past_patches(paths)
        return seen

    def _share_past_patches(self, paths: Legs) -> Tensor:
        turned = (paths.points @ self.axes.flatten(0, 1).T).movedim(-1, 0).contiguous()
        height, *place = turned.unflatten(0, self.axes.shape[:2])  # each (Q, K, n, L + 1)
        height = height - self.offset
        away, (above, below) = height.abs() > SOFT, (height[..., :-1], height[..., 1:])
        ends_here = paths.plane == self.plane
        crosses = (above * below < 0) & away[..., :-1] & away[..., 1:]
        share = torch.where(crosses, above / (above - below), 1.0)
        met = [each[..., :-1] + share * each.diff() for each in place]
        outside = 1 - _share_inside(met, self.patches) * (
            (crosses | ends_here) & paths.valid[..., None]
        )
        passed = torch.where(ends_here, 1.0, outside).movedim(-1, 0).flatten(0, 1).prod(0)
        reflected = 1 - torch.where(ends_here, outside, 1.0).prod(0)
        bounded = self.ends[paths.plane]
        seen = passed * torch.where(bounded, reflected, 1.0).prod(-1)
        # the sequences of a finite mirror are invisible where their path is not valid
        return torch.where(paths.valid | ~bounded.any(-1), seen, 0.0)


def share_past_boxes(paths: Legs, boxes: Tensor) -> Tensor:
    """Return the share (B, K, n) that passes each box,
    by the chords [m] of legs in it (slab test).
    """
    along = paths.end - paths.start
    along = torch.where(along.abs() < EDGE, EDGE, along)
    inverse, length = 1 / along, torch.linalg.vector_norm(along, dim=-1)
    enter, leave = torch.zeros(()), torch.ones(())
    corners = (each[:, None, None, None].unbind(-1) for each in boxes.chunk(2, 1))
    for start, per_metre, low, high in zip(
        paths.start.unbind(-1), inverse.unbind(-1), *corners, strict=True
    ):
        low_face, high_face = (low - start) * per_metre, (high - start) * per_metre
        enter = torch.maximum(enter, torch.minimum(low_face, high_face))
        leave = torch.minimum(leave, torch.maximum(low_face, high_face))
    chord = ((leave - enter) * length).amax(-1)  # negative for legs that miss
    passed = torch.sigmoid((MARGIN - chord) / SOFT)
    return torch.where(paths.valid, passed, 1.0)


def share_inside_patches(points: Tensor, patches: Tensor) -> Tensor:
    """Return the soft indicator (Q, ...) of points (..., 2) inside patches (Q, 4)."""
    return _share_inside([points[None, ..., 0], points[None, ..., 1]], patches)


def _share_inside(place: list[Tensor], patches: Tensor) -> Tensor:
    """Patches (Q, 4) against coordinates (1, ...), or (Q, ...), each against its own."""
    u, v = place
    low_u, low_v, high_u, high_v = (each.reshape(-1, *[1] * (u.dim() - 1)) for each in patches.T)
    inner = torch.minimum(
        torch.minimum(u - low_u, high_u - u), torch.minimum(v - low_v, high_v - v)
    )
    return torch.sigmoid(inner / SOFT)


def plane_tangents(planes: Tensor) -> Tensor:
    """Return two unit axes (2, ..., 3) float32 along planes (..., 4): level where they can be."""
    normal = hesse_form(planes)[0].float()
    up, ahead = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])
    level = (normal * up).sum(-1, keepdim=True).abs() > 0.7
    first = torch.where(level, ahead, torch.linalg.cross(up.expand_as(normal), normal))
    first = normalize(first - (first * normal).sum(-1, keepdim=True) * normal, dim=-1)
    return torch.stack([first, torch.linalg.cross(normal, first)])

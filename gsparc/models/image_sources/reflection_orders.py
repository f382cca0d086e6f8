"""Explain the sources found by fewer mirror planes, and prune sources.

A source is a sequence of planes that mirror the transmitter into it, its length the reflection
order. Each function maps a scene to a scene, kept when the likelihood allows it: a plane has three
parameters, so removing one may cost a few nats.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.refine import ROUND_STEPS, refine_scene
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import SourceScene
from gsparc.physics.mirror_planes import (
    Reflections,
    all_sequences,
    bisector,
    hesse_form,
    images,
    reflect,
)
from gsparc.processes.worker import out_of_steps

# [m] per reflection: of two sequences at the same position the shorter is preferred
LENGTH_PENALTY_M = 0.02
MIN_IMAGE_SHIFT_M = 0.2  # [m], half the least distance of a source from its mirror image
ALLOWANCE = 10.0  # nats that may be lost with a plane
ORDER = 3  # largest number of reflections of a source
# Of a source's distance from the transmitter, plus [m], to an image
WALL_TOLERANCE, LEAST_M = 0.03, 0.02
NEAR_SEQUENCE_M = 0.06  # [m], to that in perpendicular ones, plus 1 % of the distance
MOST_WALLS = 10
MANY_PLANES = 9  # beyond, third-order sequences are too many to try


def drop_planes(rows: Rows, scene: SourceScene, tolerance: float) -> SourceScene:
    """Try to remove planes until `out_of_steps`:
    sequences become the nearest over others [tolerance: m].
    """
    index = 0
    while index < len(scene.planes) and not out_of_steps():
        shorter = _remove_plane(scene, index, tolerance)
        if shorter is not None:
            shorter = refine_scene(rows, shorter, ROUND_STEPS)
            if GainPosterior(rows, shorter).nll < GainPosterior(rows, scene).nll + ALLOWANCE:
                scene = shorter
                continue
        index += 1
    return scene


def _remove_plane(scene: SourceScene, index: int, tolerance: float) -> SourceScene | None:
    """The scene without one plane; None when its strongest source has no other sequence."""
    users = [i for i, sequence in enumerate(scene.sequences) if index in sequence]
    rest = {sequence for i, sequence in enumerate(scene.sequences) if i not in users}
    order = ORDER if len(scene.planes) <= MANY_PLANES else 2
    indices = [i for i in range(len(scene.planes)) if i != index]
    candidates = [sequence for sequence in all_sequences(indices, order) if sequence not in rest]
    if not candidates or not users:
        return None
    distance = _penalised_distances(scene, candidates, scene.sources[users])
    nearest = distance.argmin(1).tolist()
    strength = (
        scene.log_amplitude[users]
        - (scene.sources[users] - scene.transmitter).norm(dim=1).clamp_min(1).log()
    )
    if distance[int(strength.argmax())].min() > tolerance:
        return None
    sequences, numbers = list(scene.sequences), set(range(len(scene.sequences)))
    for row, i in enumerate(users):
        candidate = candidates[nearest[row]]
        if distance[row].min() < tolerance and candidate not in sequences:
            sequences[i] = candidate
        else:
            numbers.discard(i)
    return replace(scene, sequences=tuple(sequences)).select_sources(sorted(numbers))


def _penalised_distances(
    scene: SourceScene, sequences: list[Reflections], places: Tensor
) -> Tensor:
    """Distances (places, sequences) [m], plus a penalty on the order."""
    position = images(scene.transmitter, scene.planes, sequences)
    order = torch.tensor([len(sequence) for sequence in sequences])
    return (position[None] - places[:, None]).norm(dim=-1) + LENGTH_PENALTY_M * order


def find_walls(sources: Tensor) -> Tensor | None:
    """Return walls: planes (P, 4) that mirror many of the sources (K, 3) into one another,
    or None.
    """
    count = len(sources)
    tolerance = _wall_tolerance(sources)
    first, second = torch.triu_indices(count, count, 1)
    planes = bisector(sources[first], sources[second])
    planes = planes[(sources[first] - sources[second]).norm(dim=1) > 2 * MIN_IMAGE_SHIFT_M]
    if len(planes) == 0:
        return None
    mirrored = reflect(sources[:, None], planes[None])  # (K, P, 3)
    # (K, P, K)
    distance = torch.cdist(mirrored.flatten(0, 1), sources).unflatten(0, mirrored.shape[:2])
    allowed = torch.maximum(tolerance[:, None], tolerance[None])[:, None]
    agreement = torch.exp(-((2 * distance / allowed) ** 2)) * (distance < allowed)
    moved = (mirrored - sources[:, None]).norm(dim=-1) > 2 * MIN_IMAGE_SHIFT_M
    agreement = agreement * moved[..., None] * ~torch.eye(count, dtype=torch.bool)[:, None]
    support = agreement.amax(2).sum(0) / 2
    chosen: list[Tensor] = []
    while len(chosen) < MOST_WALLS and support.max() >= 1.7:
        best = int(support.argmax())
        chosen.append(planes[best])
        alike = (mirrored - mirrored[:, best : best + 1]).norm(dim=-1).mean(
            0
        ) < 2 * tolerance.mean()
        support = support.masked_fill(alike, -1.0)
    return torch.stack(chosen) if chosen else None


def _wall_tolerance(sources: Tensor) -> Tensor:
    """Distances (K,) [m] from images in walls within which sources (K, 3) are these images."""
    return WALL_TOLERANCE * (sources - sources[0]).norm(dim=1) + LEAST_M


def find_orthogonal_walls(scene: SourceScene) -> Tensor | None:
    """Return the fewest planes (P, 4) of three perpendicular normals that explain most
    of a scene's sources.

    Rooms are mostly boxes: two perpendicular walls give the third normal, and a pair of sources
    that differ along one normal only gives a plane. None when no two planes are perpendicular. The
    sequences of the scene's sources may be wrong.
    """
    triad = _wall_axes(scene)
    if triad is None:
        return None
    sources = scene.sources
    allowed = NEAR_SEQUENCE_M + 0.01 * (sources - sources[0]).norm(dim=1)
    first, second = torch.triu_indices(len(sources), len(sources), 1)
    candidates = []
    for direction in triad:
        displacement = sources[second] - sources[first]
        along = displacement @ direction
        across = (displacement - along[:, None] * direction).norm(dim=1)
        fits = (across < torch.maximum(allowed[first], allowed[second])) & (
            along.abs() > 2 * MIN_IMAGE_SHIFT_M
        )
        offsets = ((sources[first] + sources[second]) @ direction / 2)[fits]
        candidates += [torch.cat([direction, offset[None]]) for offset in offsets]
    chosen, explained = scene.planes[:0], 1.0
    for _ in range(MOST_WALLS):
        plane_sets = [torch.cat([chosen, plane[None]]) for plane in candidates]
        gains = [_count_explained(scene, planes, allowed) for planes in plane_sets]
        if not gains or max(gains) < explained + 0.8:
            break
        best = gains.index(max(gains))
        chosen, explained = plane_sets[best], gains[best]
    return chosen if len(chosen) else None


def _wall_axes(scene: SourceScene) -> Tensor | None:
    """Three perpendicular unit vectors (3, 3), two of them normals of the planes used most."""
    used = [sum(i in sequence for sequence in scene.sequences) for i in range(len(scene.planes))]
    normals, _ = hesse_form(scene.planes)
    pairs = [
        (i, j) for i in range(len(used)) for j in range(i) if (normals[i] @ normals[j]).abs() < 0.02
    ]
    if not pairs:
        return None
    i, j = max(pairs, key=lambda pair: used[pair[0]] + used[pair[1]])
    second = normals[j] - (normals[j] @ normals[i]) * normals[i]
    second = second / second.norm()
    return torch.stack([normals[i], second, torch.linalg.cross(normals[i], second)])


def _count_explained(scene: SourceScene, planes: Tensor, tolerance: Tensor) -> float:
    """Number of sources with a sequence over the planes, weighted by distance and order."""
    sequences: list[Reflections] = [(), *all_sequences(list(range(len(planes))), 2)]
    position = images(scene.transmitter, planes, sequences)
    distance = torch.cdist(scene.sources, position) / tolerance[:, None]
    worth = (1 - 0.5 * distance.square()).clamp_min(0) * torch.tensor(
        [0.95 ** len(sequence) for sequence in sequences]
    )
    return float(worth.amax(1).sum())


def reassign_to_walls(scene: SourceScene, walls: Tensor) -> SourceScene:
    """Return new sequences over `walls` for all sources;
    one without a sequence gets a plane of its own.
    """
    sources = scene.sources
    tolerance = 2.5 * _wall_tolerance(sources)
    base = replace(scene, planes=walls)
    candidates = all_sequences(list(range(len(walls))), ORDER)
    distance = _penalised_distances(base, candidates, sources)
    planes, ids, assigned = [*walls], [0], set()
    sequences: list[Reflections] = [()]
    for i in range(1, len(sources)):
        near = [j for j in distance[i].argsort().tolist() if distance[i, j] < tolerance[i]]
        free = next((candidates[j] for j in near if candidates[j] not in assigned), None)
        if free is not None:
            assigned.add(free)
            sequences.append(free)
            ids.append(i)
        elif not near:  # else a duplicate of an assigned source
            planes.append(bisector(sources[0], sources[i]))
            sequences.append((len(planes) - 1,))
            ids.append(i)
    explained = replace(
        scene,
        planes=torch.stack(planes),
        sequences=tuple(sequences),
        log_amplitude=scene.log_amplitude[ids],
    )
    return explained.select_sources(list(range(len(ids))))


def prune_sources(rows: Rows, scene: SourceScene, min_gain: float) -> SourceScene:
    """Drop sources that gain under `min_gain` nats, twice with a plane of their own,
    or `out_of_steps`.
    """
    posterior, ids = GainPosterior(rows, scene), list(range(len(scene.sequences)))
    for i in sorted(ids[1:], key=lambda i: float(scene.log_amplitude[i])):
        if out_of_steps():
            break
        sole_user = any(
            sum(index in scene.sequences[j] for j in ids) == 1 for index in scene.sequences[i]
        )
        loss = posterior.nll_without_source(ids.index(i)) - posterior.nll
        if loss < (2 * min_gain if sole_user else min_gain):
            ids.remove(i)
            posterior = GainPosterior(rows, scene.select_sources(ids))
    return scene.select_sources(ids)

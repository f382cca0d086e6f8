"""Explaining found sources by fewer mirror planes, and dropping what does not pay.

Each function takes a scene to a scene; a change is kept when the likelihood allows it: a plane is three
numbers, so doing without one may cost a few nats.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsparc.multipath.gp_likelihood import Posterior, Scene
from gsparc.multipath.refine import refine
from gsparc.multipath.rows import Rows
from gsparc.physics.mirror_planes import Word, all_words, bisector, images, reflect

LONGER = 0.02  # [m] per letter: of two words at the same place the shorter is meant
WALL = 0.2  # [m], half the smallest separation that is read as a mirror image
MANY_PLANES = 9  # beyond, words of three letters are too many to try


def without_planes(rows: Rows, scene: Scene, tolerance: float, steps: int = 12, grace: float = 10.0) -> Scene:
    """Try to do without each plane: its words become the nearest words over the others [tolerance: m]."""
    letter = 0
    while letter < len(scene.planes):
        shorter = _respelled(scene, letter, tolerance)
        if shorter is not None:
            shorter = refine(rows, shorter, steps)
            if Posterior(rows, shorter).nll < Posterior(rows, scene).nll + grace:
                scene = shorter
                continue
        letter += 1
    return scene


def _respelled(scene: Scene, letter: int, tolerance: float) -> Scene | None:
    """The scene without one plane; None when its strongest source has no other spelling."""
    mine = [i for i, word in enumerate(scene.words) if letter in word]
    rest = {word for i, word in enumerate(scene.words) if i not in mine}
    order = 3 if len(scene.planes) <= MANY_PLANES else 2
    letters = [i for i in range(len(scene.planes)) if i != letter]
    spellings = [word for word in all_words(letters, order) if word not in rest]
    if not spellings or not mine:
        return None
    distance = _distances(scene, spellings, scene.sources[mine], LONGER)
    nearest = distance.argmin(1).tolist()
    strength = (
        scene.log_amplitude[mine] - (scene.sources[mine] - scene.transmitter).norm(dim=1).clamp_min(1).log()
    )
    if distance[int(strength.argmax())].min() > tolerance:
        return None
    words, kept = list(scene.words), set(range(len(scene.words)))
    for row, i in enumerate(mine):
        spelling = spellings[nearest[row]]
        if distance[row].min() < tolerance and spelling not in words:
            words[i] = spelling
        else:
            kept.discard(i)
    return replace(scene, words=tuple(words)).only(sorted(kept))


def _distances(scene: Scene, words: list[Word], places: Tensor, per_letter: float) -> Tensor:
    """Distances (places, words) [m], longer words a little farther."""
    position = images(scene.transmitter, scene.planes, words)
    letters = torch.tensor([len(word) for word in words])
    return (position[None] - places[:, None]).norm(dim=-1) + per_letter * letters


def vote(sources: Tensor, relative: float = 0.03, most: int = 10) -> Tensor | None:
    """Planes (P, 4) that map many of the sources (K, 3) onto one another: walls. None when there are none."""
    count = len(sources)
    tolerance = relative * (sources - sources[0]).norm(dim=1) + 0.02
    first, second = torch.triu_indices(count, count, 1)
    planes = bisector(sources[first], sources[second])
    planes = planes[(sources[first] - sources[second]).norm(dim=1) > 2 * WALL]
    if len(planes) == 0:
        return None
    mirrored = reflect(sources[:, None], planes[None])  # (K, P, 3)
    distance = torch.cdist(mirrored.flatten(0, 1), sources).unflatten(0, mirrored.shape[:2])  # (K, P, K)
    allowed = torch.maximum(tolerance[:, None], tolerance[None])[:, None]
    agreement = torch.exp(-((2 * distance / allowed) ** 2)) * (distance < allowed)
    moved = (mirrored - sources[:, None]).norm(dim=-1) > 2 * WALL
    agreement = agreement * moved[..., None] * ~torch.eye(count, dtype=torch.bool)[:, None]
    votes = agreement.amax(2).sum(0) / 2
    chosen: list[Tensor] = []
    while len(chosen) < most and votes.max() >= 1.7:
        best = int(votes.argmax())
        chosen.append(planes[best])
        alike = (mirrored - mirrored[:, best : best + 1]).norm(dim=-1).mean(0) < 2 * tolerance.mean()
        votes = votes.masked_fill(alike, -1.0)
    return torch.stack(chosen) if chosen else None


def upright(scene: Scene, most: int = 8, near: float = 0.06) -> Tensor | None:
    """The fewest planes (P, 4) along three perpendicular directions that spell most of a scene's sources.

    Rooms are mostly boxes: two perpendicular walls tell the third direction, and a pair of sources that
    differ along a direction only tells a plane. None when no two planes are perpendicular.

    Args:
        scene: sources that need not be spelled well.
        most: planes.
        near: how far a source may be from its spelling [m], and 1 % of its distance from the transmitter.
    """
    triad = _triad(scene)
    if triad is None:
        return None
    sources = scene.sources
    allowed = near + 0.01 * (sources - sources[0]).norm(dim=1)
    first, second = torch.triu_indices(len(sources), len(sources), 1)
    candidates = []
    for direction in triad:
        apart = sources[second] - sources[first]
        along = apart @ direction
        beside = (apart - along[:, None] * direction).norm(dim=1)
        fits = (beside < torch.maximum(allowed[first], allowed[second])) & (along.abs() > 2 * WALL)
        offsets = ((sources[first] + sources[second]) @ direction / 2)[fits]
        candidates += [torch.cat([direction, offset[None]]) for offset in offsets]
    chosen, spelled = torch.zeros(0, 4, dtype=sources.dtype), 1.0
    for _ in range(most):
        tried = [torch.cat([chosen, plane[None]]) for plane in candidates]
        gains = [_spelled(scene, planes, allowed) for planes in tried]
        if not gains or max(gains) < spelled + 0.8:
            break
        best = gains.index(max(gains))
        chosen, spelled = tried[best], gains[best]
    return chosen if len(chosen) else None


def _triad(scene: Scene) -> Tensor | None:
    """Three perpendicular unit vectors (3, 3), two of them normals of the planes used most."""
    used = [sum(i in word for word in scene.words) for i in range(len(scene.planes))]
    normals = scene.planes[:, :3] / scene.planes[:, :3].norm(dim=1, keepdim=True)
    best: tuple[int, Tensor] | None = None
    for i in range(len(used)):
        for j in range(i):
            if (normals[i] @ normals[j]).abs() < 0.02 and (best is None or used[i] + used[j] > best[0]):
                second = normals[j] - (normals[j] @ normals[i]) * normals[i]
                second = second / second.norm()
                third = torch.linalg.cross(normals[i], second)
                best = used[i] + used[j], torch.stack([normals[i], second, third])
    return None if best is None else best[1]


def _spelled(scene: Scene, planes: Tensor, allowed: Tensor) -> float:
    """How many sources have a word over planes, near ones counting more and long words less."""
    words: list[Word] = [(), *all_words(list(range(len(planes))), 2)]
    position = images(scene.transmitter, planes, words)
    distance = torch.cdist(scene.sources, position) / allowed[:, None]
    worth = (1 - 0.5 * distance.square()).clamp_min(0) * torch.tensor([0.95 ** len(word) for word in words])
    return float(worth.amax(1).sum())


def respell(scene: Scene, walls: Tensor, relative: float = 0.03) -> Scene:
    """All sources spelled anew over `walls`; what has no spelling gets a plane of its own."""
    sources = scene.sources
    tolerance = 2.5 * (relative * (sources - sources[0]).norm(dim=1) + 0.02)
    base = replace(scene, planes=walls)
    spellings = all_words(list(range(len(walls))), 3)
    distance = _distances(base, spellings, sources, 1.5 * LONGER)
    planes, kept, taken = [*walls], [0], set()
    words: list[Word] = [()]
    for i in range(1, len(sources)):
        near = [j for j in distance[i].argsort()[:6].tolist() if distance[i, j] < tolerance[i]]
        free = next((spellings[j] for j in near if spellings[j] not in taken), None)
        if free is not None:
            taken.add(free)
            words.append(free)
            kept.append(i)
        elif not near:  # else a double of a source that has a name already
            planes.append(bisector(sources[0], sources[i]))
            words.append((len(planes) - 1,))
            kept.append(i)
    spelled = replace(
        scene, planes=torch.stack(planes), words=tuple(words), log_amplitude=scene.log_amplitude[kept]
    )
    return spelled.only(list(range(len(kept))))


def prune(rows: Rows, scene: Scene, least: float) -> Scene:
    """Drop sources that gain fewer than `least` nats (twice that when a plane serves them alone)."""
    posterior = Posterior(rows, scene)
    names: list[Word] = sorted(
        scene.words[1:], key=lambda word: float(scene.log_amplitude[scene.words.index(word)])
    )
    alive = set(range(len(scene.words)))
    for word in names:
        i = scene.words.index(word)
        alone = any(sum(letter in scene.words[j] for j in alive) == 1 for letter in word)
        current = scene.only(sorted(alive))
        position = sorted(alive).index(i)
        if posterior.without(position) - posterior.nll < (2 * least if alone else least):
            alive.discard(i)
            current = scene.only(sorted(alive))
            posterior = Posterior(rows, current)
    return scene.only(sorted(alive))

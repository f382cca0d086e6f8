"""Mirror images of the static end in known walls: those that some receiver sees, strongest first."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import groupby

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import Clutter, tangents, visible_share
from gsparc.models.image_sources.clutter.unfold import SAME_M, Paths, Unfolding
from gsparc.models.image_sources.known.mirrors import Mirrors
from gsparc.physics.mirror_planes import Reflections, all_sequences, images

REFLECTED = 0.6  # amplitude that a reflection leaves, of building materials
MOST_SEQUENCES = 3_000  # sequences of walls of each length that are looked at, over the largest of them
LOOKED_FROM = 100  # places
SEQUENCES_AT_ONCE = 400
SHORTLIST = 4  # times as many as are wanted, before what walls hide is looked at
SEEN = 1e-3  # mean share of an image that is kept
HIDES = 0.01  # share of one image that a rectangle takes, to be kept


def affordable(mirrors: int, length: int) -> int:
    """How many mirrors, at most `mirrors`, have at most `MOST_SEQUENCES` sequences of so many reflections."""
    count = mirrors
    while count > 1 and count * (count - 1) ** (length - 1) > MOST_SEQUENCES:
        count -= 1
    return count


def visible_sequences(
    mirrors: Mirrors,
    indices: list[int],
    transmitter: Tensor,
    places: Tensor,
    order: int,
    most: int,
    hidden: bool,
) -> tuple[Reflections, ...]:
    """At most `most` sequences, the static end's own first, then by power expected at the places.

    Args:
        mirrors: planes and rectangles.
        indices: planes that mirror, the largest first.
        transmitter: (3,) float64 [m].
        places: (n, 3) float64 [m] of receivers.
        order: largest number of reflections.
        most: sequences.
        hidden: whether walls end and hide; else every image is seen from everywhere.
    """
    places = places[torch.linspace(0, len(places) - 1, min(LOOKED_FROM, len(places))).long()]
    candidates = [
        sequence
        for length in range(1, order + 1)
        for sequence in all_sequences(indices[: affordable(len(indices), length)], length)
        if len(sequence) == length
    ]
    sequences = _distinct(candidates, transmitter, mirrors.planes)
    if not sequences or most < 2:
        return ((),)
    scores = torch.cat(
        [
            _power(mirrors, sequences[i : i + SEQUENCES_AT_ONCE], transmitter, places, hidden)
            for i in range(0, len(sequences), SEQUENCES_AT_ONCE)
        ]
    )
    kept = scores.topk(min(SHORTLIST * most, len(sequences))).indices
    kept = kept[scores[kept] > 0]
    if hidden and len(kept):
        parts = [
            _seen(mirrors, [sequences[i] for i in part.tolist()], transmitter, places)
            for part in kept.split(50)
        ]
        seen = torch.cat(parts)
        kept, power = kept[seen > SEEN], (scores[kept] * seen)[seen > SEEN]
        kept = kept[power.argsort(descending=True)]
    return ((), *(sequences[i] for i in kept[: most - 1].tolist()))


def hiding(
    mirrors: Mirrors, sequences: tuple[Reflections, ...], transmitter: Tensor, places: Tensor
) -> Clutter:
    """The rectangles that sequences are mirrored in or that hide one of them from a place, and the boxes."""
    clutter = mirrors.clutter
    paths = Unfolding.of(transmitter, mirrors.planes, sequences).paths(places)
    used = {index for sequence in sequences for index in sequence}
    kept = []
    for number, plane in enumerate(clutter.plane):
        one = Clutter(clutter.boxes[:0], clutter.patches[number : number + 1], (plane,))
        taken = 1 - visible_share(paths, one, mirrors.planes)
        if plane in used or float(taken.max()) > HIDES:
            kept.append(number)
    return replace(clutter, patches=clutter.patches[kept], plane=tuple(clutter.plane[i] for i in kept))


def _distinct(sequences: list[Reflections], transmitter: Tensor, planes: Tensor) -> list[Reflections]:
    """One sequence of each image: perpendicular mirrors have the same in both orders."""
    if not sequences:
        return []
    places = images(transmitter, planes, sequences)
    kept: list[int] = []
    numbers = sorted(range(len(sequences)), key=lambda i: (len(sequences[i]), sorted(sequences[i])))
    for _, group in groupby(numbers, key=lambda i: sorted(sequences[i])):
        mine: list[int] = []
        for i in group:
            if all(float((places[i] - places[j]).norm()) > SAME_M for j in mine):
                mine.append(i)
        kept += mine
    return [sequences[i] for i in sorted(kept)]


def _power(
    mirrors: Mirrors, sequences: list[Reflections], transmitter: Tensor, places: Tensor, hidden: bool
) -> Tensor:
    """Expected power (W,) of sequences over that of 1 m, where rectangles reflect them; nothing hides."""
    away = torch.cdist(images(transmitter, mirrors.planes, sequences), places).clamp_min(0.1)
    order = torch.tensor([len(sequence) for sequence in sequences])
    power = away.square().reciprocal()
    if hidden:
        power = power * _reflected(
            mirrors, Unfolding.of(transmitter, mirrors.planes, tuple(sequences)).paths(places)
        )
    return power.mean(1) * REFLECTED ** (2 * order)


def _reflected(mirrors: Mirrors, paths: Paths) -> Tensor:
    """Whether (W, n) every leg of a sequence ends on a rectangle of its plane, as 0 and 1."""
    clutter, inside = mirrors.clutter, paths.plane < 0
    for patch, plane in zip(clutter.patches, clutter.plane, strict=True):
        here = paths.plane == plane
        if not bool(here.any()):
            continue
        met = paths.end[here] @ tangents(mirrors.planes[plane]).T
        inside[here] |= ((met >= patch[:2]) & (met <= patch[2:])).all(1)
    return (inside.all(-1) & paths.valid).float()


def _seen(mirrors: Mirrors, sequences: list[Reflections], transmitter: Tensor, places: Tensor) -> Tensor:
    """Mean visible share (W,) of sequences, walls and boxes in the way included."""
    paths = Unfolding.of(transmitter, mirrors.planes, tuple(sequences)).paths(places)
    return visible_share(paths, mirrors.clutter, mirrors.planes).mean(1)


def start_amplitudes(sequences: tuple[Reflections, ...], direct: float) -> Tensor:
    """Log amplitudes (K,) float32 to start from, given the direct wave's amplitude."""
    order = torch.tensor([float(len(sequence)) for sequence in sequences])
    return math.log(max(direct, 1e-6)) + order * math.log(REFLECTED)

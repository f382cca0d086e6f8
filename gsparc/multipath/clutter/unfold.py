"""Unfold reflection words into the straight legs of their paths, from receiver to transmitter (image method).

The path of word (i, j) leaves the receiver towards the image of the whole word, meets plane j there,
continues towards the image of (i,), and so on. Of perpendicular mirrors both orders have the same image;
which of them a receiver sees follows from where the line to the image meets the planes first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise, permutations

import torch
from torch import Tensor

from gsparc.physics.mirror_planes import Word, images, reflect

SAME_M = 0.05  # [m], words of the same planes whose images are closer are the same source
EDGE = 1e-6  # tolerance of the intersection of a leg with a plane
PARALLEL = 1e-9  # [m], difference of heights over a plane that legs along it are given


@dataclass(frozen=True)
class Paths:
    """Legs of K words from n places.

    Attributes:
        points: (K, n, L + 1, 3) float32 [m], place, reflections, transmitter; words shorter than L - 1 are
            padded with legs of no length.
        letter: (K, n, L) plane met at the end of each leg, -1 for none.
        valid: (K, n) bool, whether the word's planes are met in order between receiver and image.
    """

    points: Tensor
    letter: Tensor
    valid: Tensor

    @property
    def start(self) -> Tensor:
        """(K, n, L, 3) of each leg [m]."""
        return self.points[:, :, :-1]

    @property
    def end(self) -> Tensor:
        """(K, n, L, 3) of each leg [m]."""
        return self.points[:, :, 1:]

    def take(self, words: Tensor | list[int]) -> Paths:
        """Of some words."""
        return Paths(self.points[words], self.letter[words], self.valid[words])


@dataclass(frozen=True)
class Unfolding:
    """All orders of the planes of K words with the same image, prepared for unfolding.

    Attributes:
        chain: (L, K, M, 1, 3) float32 [m]; entry l is the image after l letters.
        normal: (L - 1, K, M, 1, 3) float32 unit normals of the letters' planes; zero beyond the word's end.
        offset: (L - 1, K, M, 1) float32 [m]; zero beyond.
        height: (L - 1, K, M, 1) float32 [m], of the image after the letter over its plane; -1 beyond, so that
            legs there have no length.
        letter: (K, M, 1, L) in the order in which a path meets them, -1 where there is none.
        given: (K, M, 1) bool, whether the entry exists.
    """

    chain: Tensor
    normal: Tensor
    offset: Tensor
    height: Tensor
    letter: Tensor
    given: Tensor

    @staticmethod
    def of(transmitter: Tensor, planes: Tensor, words: tuple[Word, ...]) -> Unfolding:
        """From a scene's transmitter (3,), planes (P, 4) and words."""
        variants = _equivalent_words(transmitter, planes, words)
        most, order = max(map(len, variants)), max(map(len, words), default=0)
        letter = torch.full((order, len(words), most, 1), -1)
        given = torch.zeros(len(words), most, 1, dtype=torch.bool)
        for k, mine in enumerate(variants):
            for m, word in enumerate(mine):
                letter[: len(word), k, m, 0] = torch.tensor(word, dtype=torch.long)
                given[k, m] = True
        table = planes if len(planes) else torch.tensor([[1.0, 0, 0, 0]], dtype=planes.dtype)
        used, exists = table[letter.clamp_min(0)], letter >= 0
        chain = [transmitter.expand(*given.shape, 3)]
        for plane, here in zip(used, exists, strict=True):
            chain.append(torch.where(here[..., None], reflect(chain[-1], plane), chain[-1]))
        length = torch.linalg.vector_norm(used[..., :3], dim=-1, keepdim=True)
        normal = (used[..., :3] / length).float() * exists[..., None]
        offset, images_at = used[..., 3].float() * exists, torch.stack(chain).float()
        height = (images_at[1:] * normal).sum(-1) - offset
        met = torch.cat([letter.flip(0), torch.full((1, *given.shape), -1)]).permute(1, 2, 3, 0)
        return Unfolding(images_at, normal, offset, torch.where(exists, height, -1.0), met, given)

    @staticmethod
    def concatenate(many: list[Unfolding]) -> Unfolding:
        """Of several scenes, with consecutive plane indices."""
        variants = max(u.given.shape[1] for u in many)
        length = max(len(u.chain) for u in many)
        parts = zip(*(vars(u.padded(variants, length)).values() for u in many), strict=True)
        return Unfolding(*(torch.cat(part, 0 if i > 3 else 1) for i, part in enumerate(parts)))

    def padded(self, variants: int, length: int) -> Unfolding:
        """With room for more variants and letters."""
        pad = torch.nn.functional.pad
        more, longer = variants - self.given.shape[1], length - len(self.chain)
        chain = torch.cat([self.chain, self.chain[-1:].expand(longer, -1, -1, -1, -1)])
        return Unfolding(
            pad(chain, (0, 0, 0, 0, 0, more)),
            pad(self.normal, (0, 0, 0, 0, 0, more, 0, 0, 0, longer)),
            pad(self.offset, (0, 0, 0, more, 0, 0, 0, longer)),
            pad(self.height, (0, 0, 0, more, 0, 0, 0, longer), value=-1.0),
            pad(self.letter, (longer, 0, 0, 0, 0, more), value=-1),
            pad(self.given, (0, 0, 0, more)),
        )

    def with_offset(self, first: int) -> Unfolding:
        """Plane indices increased by `first`."""
        return replace(self, letter=torch.where(self.letter >= 0, self.letter + first, -1))

    def paths(self, places: Tensor) -> Paths:
        """From places (n, 3) [m]."""
        shape = (*self.given.shape[:2], len(places))
        here, valid = places.float().expand(*shape, 3), self.given.expand(shape)
        points = [here]
        steps = list(zip(self.normal, self.offset, self.height, self.chain[1:], strict=True))
        for normal, offset, height, image in reversed(steps):
            above = (here * normal).sum(-1) - offset
            share = above / (above - height + PARALLEL)
            valid = valid & ((share - 0.5).abs() < 0.5 + EDGE)
            here = torch.lerp(here, image, share.clamp(0, 1)[..., None])
            points.append(here)
        points.append(self.chain[0].expand_as(here))
        chosen = valid.int().argmax(1)  # the first valid variant, else the first
        letter = _pick(self.letter.expand(*shape, -1), chosen)
        return Paths(_pick(torch.stack(points, -2), chosen), letter, valid.any(1))


def _pick(values: Tensor, chosen: Tensor) -> Tensor:
    """(K, M, n, ...) at variant `chosen` (K, n)."""
    if values.shape[1] == 1:
        return values[:, 0]
    index = chosen[:, None].reshape(len(chosen), 1, -1, *[1] * (values.dim() - 3))
    return values.gather(1, index.expand(-1, 1, *values.shape[2:]))[:, 0]


def _equivalent_words(transmitter: Tensor, planes: Tensor, words: tuple[Word, ...]) -> list[list[Word]]:
    """Each word, then its permutations with the same image."""
    found = []
    for word in words:
        others = [
            other
            for other in dict.fromkeys(permutations(word))
            if other != word and all(a != b for a, b in pairwise(other))
        ]
        if others:
            places = images(transmitter, planes, [word, *others])
            same = (places[1:] - places[0]).norm(dim=1) < SAME_M
            others = [other for other, alike in zip(others, same.tolist(), strict=True) if alike]
        found.append([word, *others])
    return found

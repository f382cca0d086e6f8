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


@dataclass(frozen=True)
class Paths:
    """Legs of K words from n places.

    Attributes:
        start, end: (K, n, L, 3) float32 [m]; words shorter than L - 1 are padded with legs of no length.
        letter: (K, n, L) plane met at the end of each leg, -1 for none.
        valid: (K, n) bool, whether the word's planes are met in order between receiver and image.
    """

    start: Tensor
    end: Tensor
    letter: Tensor
    valid: Tensor

    def take(self, words: Tensor | list[int]) -> Paths:
        """Of some words."""
        return Paths(self.start[words], self.end[words], self.letter[words], self.valid[words])


@dataclass(frozen=True)
class Unfolding:
    """All orders of the planes of K words with the same image, prepared for unfolding.

    Attributes:
        chain: (K, M, L, 3) float32 [m]; entry l is the image after l letters.
        normal: (K, M, L - 1, 3) float32 unit normals of the letters' planes.
        offset: (K, M, L - 1) float32 [m].
        letter: (K, M, L - 1), -1 beyond the word's end.
        given: (K, M) bool, whether the entry exists.
    """

    chain: Tensor
    normal: Tensor
    offset: Tensor
    letter: Tensor
    given: Tensor

    @staticmethod
    def of(transmitter: Tensor, planes: Tensor, words: tuple[Word, ...]) -> Unfolding:
        """From a scene's transmitter (3,), planes (P, 4) and words."""
        variants = _equivalent_words(transmitter, planes, words)
        most, order = max(map(len, variants)), max(map(len, words), default=0)
        letter = torch.full((len(words), most, order), -1)
        given = torch.zeros(len(words), most, dtype=torch.bool)
        for k, mine in enumerate(variants):
            for m, word in enumerate(mine):
                letter[k, m, : len(word)] = torch.tensor(word, dtype=torch.long)
                given[k, m] = True
        table = planes if len(planes) else torch.tensor([[1.0, 0, 0, 0]], dtype=planes.dtype)
        used = table[letter.clamp_min(0)]
        chain = [transmitter.expand(*letter.shape[:2], 3)]
        for step in range(order):
            mirrored = reflect(chain[-1], used[:, :, step])
            chain.append(torch.where((letter[:, :, step] >= 0)[..., None], mirrored, chain[-1]))
        length = torch.linalg.vector_norm(used[..., :3], dim=-1, keepdim=True)
        normal = (used[..., :3] / length).float()
        return Unfolding(torch.stack(chain, 2).float(), normal, used[..., 3].float(), letter, given)

    @staticmethod
    def concatenate(many: list[Unfolding]) -> Unfolding:
        """Of several scenes, with consecutive plane indices."""
        variants = max(u.letter.shape[1] for u in many)
        order = max(u.letter.shape[2] for u in many)
        padded = [u.padded(variants, order) for u in many]
        return Unfolding(*map(torch.cat, zip(*(vars(u).values() for u in padded), strict=True)))

    def padded(self, variants: int, order: int) -> Unfolding:
        """With room for more variants and letters."""
        pad = torch.nn.functional.pad
        more, longer = variants - self.letter.shape[1], order - self.letter.shape[2]
        chain = torch.cat([self.chain, self.chain[:, :, -1:].expand(-1, -1, longer, -1)], 2)
        return Unfolding(
            pad(chain, (0, 0, 0, 0, 0, more)),
            pad(self.normal, (0, 0, 0, longer, 0, more)),
            pad(self.offset, (0, longer, 0, more)),
            pad(self.letter, (0, longer, 0, more), value=-1),
            pad(self.given, (0, more)),
        )

    def with_offset(self, first: int) -> Unfolding:
        """Plane indices increased by `first`."""
        return replace(self, letter=torch.where(self.letter >= 0, self.letter + first, -1))

    def paths(self, places: Tensor) -> Paths:
        """From places (n, 3) [m]."""
        shape = (*self.letter.shape[:2], len(places))
        here = places.float().expand(*shape, 3)
        valid = self.given[..., None].expand(shape)
        starts, ends, letters = [], [], []
        for step in range(self.letter.shape[2] - 1, -1, -1):
            exists = (self.letter[:, :, step] >= 0)[..., None]
            normal, offset = self.normal[:, :, None, step], self.offset[:, :, None, step]
            target = self.chain[:, :, None, step + 1]
            above, below = (here * normal).sum(-1) - offset, (target * normal).sum(-1) - offset
            apart = above - below
            share = above / torch.where(apart.abs() < 1e-9, torch.full_like(apart, 1e-9), apart)
            valid = valid & (~exists | ((share > -EDGE) & (share < 1 + EDGE)))
            share = torch.where(exists, share.clamp(0, 1), torch.zeros_like(share))
            met = here + share[..., None] * (target - here)
            starts.append(here)
            ends.append(met)
            letters.append(self.letter[:, :, None, step].expand(shape))
            here = met
        starts.append(here)
        ends.append(self.chain[:, :, None, 0].expand_as(here))
        letters.append(torch.full(shape, -1))
        chosen = valid.int().argmax(1)  # the first valid variant, else the first
        return Paths(
            _pick(torch.stack(starts, -2), chosen),
            _pick(torch.stack(ends, -2), chosen),
            _pick(torch.stack(letters, -1), chosen),
            valid.any(1),
        )


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

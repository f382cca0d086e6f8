"""Mirror planes and the images they make of a transmitter.

A plane is (n, b): all p with n.p = b, n normalised on use. A reflection sequence (i, j, ...) is the
transmitter mirrored in plane i, then in plane j, and so on: a plane costs three numbers and gives
many sources.
"""

from __future__ import annotations

from itertools import pairwise, product

import torch
from torch import Tensor
from torch.nn.functional import normalize

NO_PLANES = torch.zeros(0, 4, dtype=torch.float64)
Reflections = tuple[int, ...]  # indices of planes, in the order in which they mirror


def hesse_form(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit normals (..., 3) and offsets (..., 1) [m] of planes (..., 4),
    Hesse's normal form.

    >>> hesse_form(torch.tensor([0.0, 0.0, 2.0, 3.0]))
    (tensor([0., 0., 1.]), tensor([3.]))
    """
    normal, offset = planes.split((3, 1), -1)
    return normalize(normal, dim=-1), offset


def reflect(points: Tensor, planes: Tensor) -> Tensor:
    """Mirror points (..., 3) [m] in planes (..., 4), broadcast against each other.

    In the floor z = 0:

    >>> reflect(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.0, 0.0, 1.0, 0.0]))
    tensor([ 1.,  2., -3.])
    """
    normal, offset = hesse_form(planes)
    height = (points * normal).sum(-1, keepdim=True) - offset
    return points - 2 * height * normal


def bisector(first: Tensor, second: Tensor) -> Tensor:
    """Return the planes (..., 4) that mirror `first` (..., 3) into `second` (..., 3).

    >>> bisector(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 5.0]))  # z = 3
    tensor([0., 0., 1., 3.])
    """
    normal = normalize(second - first, dim=-1)
    return torch.cat([normal, (normal * (first + second) / 2).sum(-1, keepdim=True)], -1)


def images(
    transmitter: Tensor, planes: Tensor, sequences: tuple[Reflections, ...] | list[Reflections]
) -> Tensor:
    """Return positions (..., K, 3) [m] of sequences, differentiable in transmitter (..., 3),
    planes (P, 4).

    The floor, and a wall x = 5:

    >>> planes = torch.tensor([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 5.0]])
    >>> images(torch.tensor([1.0, 2.0, 3.0]), planes, [(0,), (0, 1)])
    tensor([[ 1.,  2., -3.],
            [ 9.,  2., -3.]])
    """
    order = max(map(len, sequences), default=0)
    place = transmitter[..., None, :].expand(*transmitter.shape[:-1], len(sequences), 3)
    # Shorter sequences end in -1, which mirrors nothing: all are mirrored in as many steps.
    indices = torch.tensor([[*w, *[-1] * (order - len(w))] for w in sequences], dtype=torch.long)
    for step in range(order):
        index = indices[:, step]
        mirrored = reflect(place, planes[index.clamp_min(0)])
        place = torch.where((index >= 0)[:, None], mirrored, place)
    return place


def image_rotations(
    planes: Tensor, sequences: tuple[Reflections, ...] | list[Reflections]
) -> Tensor:
    """Return orthogonal parts Q (K, 3, 3) of the sequences: the image of t + a is that of t,
    plus Q a.

    One reflection in a plane of unit normal n is `I - 2 n n^T` (J. B. Allen and D. A. Berkley, J.
    Acoust. Soc. Am. 65 (1979)); a sequence is their product, the first plane rightmost.

    >>> image_rotations(torch.tensor([[0.0, 0.0, 1.0, 2.0]]), [(0,)])[0].diagonal()  # z turns round
    tensor([ 1.,  1., -1.])
    """
    ends = torch.cat([torch.zeros(1, 3, dtype=planes.dtype), torch.eye(3, dtype=planes.dtype)])
    placed = images(ends, planes, sequences)  # (4, K, 3)
    return (placed[1:] - placed[:1]).permute(1, 2, 0)


def all_sequences(indices: list[int], order: int) -> list[Reflections]:
    """Return sequences of 1 to `order` planes in which none follows itself (a mirror twice is no
    mirror).

    >>> all_sequences([0, 1], order=2)
    [(0,), (1,), (0, 1), (1, 0)]
    """
    return [
        sequence
        for length in range(1, order + 1)
        for sequence in product(indices, repeat=length)
        if all(a != b for a, b in pairwise(sequence))
    ]

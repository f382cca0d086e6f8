"""Measured channels as rows of one regression: a place, a frequency and what was measured there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.ops import Pose


@dataclass(frozen=True)
class Rows:
    """n complex numbers per output, each at one place and one frequency.

    Attributes:
        position: (n, 3) float64 [m], local.
        frequency: (n,) float64 [Hz].
        target: (n, R) complex64; R outputs share sources and visibility but not gains.
        receiver: (n,) int64, which measurement a row belongs to.
    """

    position: Tensor
    frequency: Tensor
    target: Tensor
    receiver: Tensor

    def __len__(self) -> int:
        return len(self.position)

    def take(self, index: Tensor) -> Rows:
        """The rows with these numbers."""
        return Rows(self.position[index], self.frequency[index], self.target[index], self.receiver[index])


def elements(site: Site, position: np.ndarray, rotation: np.ndarray, antennas: int) -> np.ndarray:
    """Places (S, E, 3) float64 [m] of the antennas; E = 1 when the array's geometry is not known."""
    if site.array is None or antennas == 1:
        return position[:, None, :]
    return position[:, None, :] + np.einsum("sij,ej->sei", rotation, np.asarray(site.array, np.float64))


def query_elements(site: Site, rx: Pose, count: int, antennas: int) -> Tensor:
    """The same (count, E, 3) for queries, with autograd: `count` poses, or one shared by all."""
    places = rx.position.cpu().double().reshape(-1, 1, 3)
    if site.array is not None and antennas > 1:
        rotation = rx.rotation.cpu().double().reshape(-1, 3, 3)
        places = places + torch.einsum("sij,ej->sei", rotation, torch.as_tensor(site.array).double())
    return places.expand(count, -1, 3)


def gather(data: Measurements, index: np.ndarray, limit: int, seed: int) -> Rows:
    """At most `limit` rows from the given measurements.

    Every measurement gives the same number of tones, a comb over the band with a random start, so that
    together they cover it. When one tone each exceeds the limit, measurements are subsampled.

    Args:
        data: kind csi; a transmitter that moves before one antenna is, by reciprocity, a moving receiver.
        index: (S,) measurements to draw from.
        limit: largest number of rows.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    index = np.asarray(index)
    antennas, tones = data.target.shape[1:]
    frequency = data.site.tones()
    places = elements(data.site, data.moving[index], data.rx_rotation[index], antennas)
    per = places.shape[1]
    if len(index) * per > limit:
        kept = np.sort(rng.permutation(len(index))[: max(limit // per, 1)])
        index, places = index[kept], places[kept]
    wanted = min(max(limit // max(len(index) * per, 1), 1), tones)
    position, tone, target, receiver = [], [], [], []
    for row, place in zip(index, places, strict=True):
        values = data.target[row]  # (A, K)
        measured = np.ones((antennas, tones), bool) if data.mask is None else data.mask[row]
        for e in range(per):
            known = np.flatnonzero(measured[e] if per > 1 else measured.all(0))
            count = min(wanted, len(known))
            if count == 0:
                continue
            comb = np.floor((np.arange(count) + rng.random()) * len(known) / count).astype(int)
            chosen = known[comb]
            tone.append(frequency[chosen])
            position.append(np.repeat(place[e][None], count, 0))
            target.append(values[e, chosen][:, None] if per > 1 else values[:, chosen].T)
            receiver.append(np.full(count, row))
    return Rows(
        torch.from_numpy(np.concatenate(position)),
        torch.from_numpy(np.concatenate(tone)),
        torch.from_numpy(np.concatenate(target).astype(np.complex64)),
        torch.from_numpy(np.concatenate(receiver)).long(),
    )

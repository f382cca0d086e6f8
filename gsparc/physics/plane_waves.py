"""Plane waves with a delay: response of one source at every antenna and tone.

h[a, k] = sum_n g_n exp(+j 2 pi q_a . w_n) exp(-j 2 pi k t_n), with q_a the antenna's place in the
array's plane in wavelengths, w_n the source's direction cosines in that plane, k the tone's number
and t_n its delay in turns per tone. An atom and its slopes by both cosines and the delay are
products of one vector over antennas and one over tones, and so are their inner products: every
matrix of the search is cut from one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Aperture:
    """Where a snapshot is measured.

    Attributes:
        places: (A, 2) float32 antennas in the array's plane, in wavelengths about their middle.
        tones: (K,) float32 numbers of the tones, in spacings about the middle of the band they
            belong to.
    """

    places: Tensor
    tones: Tensor

    @cached_property
    def cosine_slope(self) -> Tensor:
        """Factor (2, 1, A) of the derivative by a direction cosine."""
        return (2j * math.pi * self.places.T)[:, None]

    @cached_property
    def delay_slope(self) -> Tensor:
        """Factor (K,) of the derivative by the delay."""
        return -2j * math.pi * self.tones


def planar_places(array: np.ndarray, wavelength: float) -> Tensor:
    """Return antennas (A, 3) [m] as (A, 2) float32 wavelengths along their two widest axes.

    About the middle:

    >>> planar_places(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]), 0.5)[:, 0].abs()
    tensor([1., 1.])
    """
    centred = (array - array.mean(axis=0)) / wavelength
    # Right singular vectors of centred places are their principal axes, the widest first.
    axes = np.linalg.svd(centred, full_matrices=True)[2][:2]
    return torch.from_numpy(centred @ axes.T).float()


@dataclass(frozen=True)
class SourceColumns:
    """Responses of N sources and their derivatives on an aperture: 4 N columns,
    each antennas times tones.

    The slopes are of an atom of gain 1, by its first cosine, its second and its delay,
    in that order.

    Attributes:
        antennas: (B, 3, N, A) complex64: the atoms, and them by both cosines.
        tones: (B, 2, N, K) complex64: the atoms, and them by the delay.
    """

    antennas: Tensor
    tones: Tensor

    @staticmethod
    def from_sources(direction: Tensor, delay: Tensor, aperture: Aperture) -> SourceColumns:
        """Return columns of sources with direction cosines (B, N, 2) and delays (B, N)."""
        over_antennas = antenna_responses(direction, aperture)[:, None]
        over_tones = tone_responses(delay, aperture)[:, None]
        by_cosine = over_antennas * aperture.cosine_slope
        by_delay = over_tones * aperture.delay_slope
        return SourceColumns(
            torch.cat([over_antennas, by_cosine], 1), torch.cat([over_tones, by_delay], 1)
        )

    def gram(self) -> Tensor:
        """Return inner products (B, 4 N, 4 N) of all columns."""
        n = self.antennas.shape[2]
        over_antennas, over_tones = (flat.conj() @ flat.mT for flat in self._flat())
        for side in (1, 2):  # columns are (atom, slope by x, by y, by delay)
            atom, by_tones = over_antennas.narrow(side, 0, n), over_tones.narrow(side, 0, n)
            over_antennas = torch.cat([over_antennas, atom], side)
            over_tones = torch.cat([by_tones, by_tones, over_tones], side)
        return over_antennas * over_tones

    def inner_products(self, snapshot: Tensor) -> Tensor:
        """Return inner products (B, 4 N) of all columns with snapshots (B, A, K)."""
        n, (antennas, tones) = self.antennas.shape[2], self._flat()
        correlation = antennas.conj() @ snapshot
        by_cosine = (correlation.unflatten(1, (3, n)) * tones[:, None, :n].conj()).sum(-1)
        by_delay = (correlation[:, :n] * tones[:, n:].conj()).sum(-1)
        return torch.cat([by_cosine.flatten(1), by_delay], 1)

    def _flat(self) -> tuple[Tensor, Tensor]:
        return self.antennas.flatten(1, 2), self.tones.flatten(1, 2)

    def channels(self, gain: Tensor) -> Tensor:
        """Return channels (B, A, K) of the atoms with gains (B, N)."""
        return (self.antennas[:, 0] * gain[..., None]).transpose(1, 2) @ self.tones[:, 0]


def phasor(turns: Tensor) -> Tensor:
    """Return exp(j 2 pi turns), complex.

    >>> phasor(torch.tensor(0.5)).real
    tensor(-1.)
    """
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns)


def antenna_responses(direction: Tensor, aperture: Aperture) -> Tensor:
    """Return responses (B, N, A) complex of the antennas to direction cosines (B, N, 2)."""
    return phasor(direction @ aperture.places.T)


def tone_responses(delay: Tensor, aperture: Aperture) -> Tensor:
    """Return responses (B, N, K) complex of the tones to delays (B, N) [turns per tone]."""
    return phasor(-delay[..., None] * aperture.tones)


def mean_delay(snapshot: Tensor) -> Tensor:
    """Return the mean delay (B,) [turns per tone], by power, of snapshots (B, A, K),
    from neighbouring tones.

    >>> aperture = Aperture(torch.zeros(1, 2), torch.arange(4.0))
    >>> mean_delay(tone_responses(torch.tensor([[0.1]]), aperture))  # one path, as (B, 1, K)
    tensor([0.1000])
    """
    # From one tone to the next a path turns by -2 pi times its delay;
    # the sum weighs paths by their power.
    return -torch.angle((snapshot[..., 1:] * snapshot[..., :-1].conj()).sum((1, 2))) / (2 * math.pi)

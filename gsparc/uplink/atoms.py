"""Plane waves with a delay: what one source puts on every antenna and tone.

h[a, k] = sum_n g_n exp(+j 2 pi q_a . w_n) exp(-j 2 pi k t_n), with q_a the antenna's place in the array's
plane in wavelengths, w_n the source's direction cosines in that plane, k the tone's number and t_n its delay
in turns per tone. Gram matrices of such atoms are products of one over antennas and one over tones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Aperture:
    """Where a snapshot is measured.

    Attributes:
        places: (A, 2) float32 antennas in the array's plane, in wavelengths about their middle.
        tones: (K,) float32 numbers of the tones, in spacings about the middle of the band they belong to.
    """

    places: Tensor
    tones: Tensor

    def at(self, tones: Tensor) -> Aperture:
        """The same array at other tones."""
        return Aperture(self.places, tones.to(self.places))


def flat_places(array: np.ndarray, wavelength: float) -> Tensor:
    """Antennas (A, 3) [m] as (A, 2) float32 wavelengths along their two widest axes."""
    centred = (array - array.mean(axis=0)) / wavelength
    axes = np.linalg.svd(centred, full_matrices=True)[2][:2]
    return torch.from_numpy(centred @ axes.T).float()


@dataclass(frozen=True)
class Sources:
    """N sources of each of B snapshots.

    Attributes:
        direction: (B, N, 2) cosines in the array's plane.
        delay: (B, N) turns per tone.
        gain: (B, N) complex64.
        variance: (B, N) of the gains.
        delay_variance: (B, N) of the delays.
    """

    direction: Tensor
    delay: Tensor
    gain: Tensor
    variance: Tensor
    delay_variance: Tensor

    def response(self, aperture: Aperture) -> Tensor:
        """Channels (B, A, K) complex64."""
        over_antennas, over_tones = steering(self.direction, aperture), delays(self.delay, aperture)
        return (over_antennas * self.gain[..., None]).transpose(1, 2) @ over_tones


def phasor(turns: Tensor) -> Tensor:
    """exp(j 2 pi turns), complex."""
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns)


def steering(direction: Tensor, aperture: Aperture) -> Tensor:
    """(B, N, A) complex."""
    return phasor(direction @ aperture.places.T)


def delays(delay: Tensor, aperture: Aperture) -> Tensor:
    """(B, N, K) complex."""
    return phasor(-delay[..., None] * aperture.tones)


def gram(antennas: Tensor, tones: Tensor, antennas2: Tensor, tones2: Tensor) -> Tensor:
    """Inner products (B, N, M) of atoms (B, N, A), (B, N, K) with others."""
    over_antennas = antennas.conj() @ antennas2.transpose(1, 2)
    return over_antennas * (tones.conj() @ tones2.transpose(1, 2))


def inner(antennas: Tensor, tones: Tensor, snapshot: Tensor) -> Tensor:
    """Inner products (B, N) of atoms with snapshots (B, A, K)."""
    return ((antennas.conj() @ snapshot) * tones.conj()).sum(-1)


def mean_delay(snapshot: Tensor) -> Tensor:
    """Power-weighted mean delay (B,) of snapshots (B, A, K), turns per tone, from neighbouring tones."""
    return -torch.angle((snapshot[..., 1:] * snapshot[..., :-1].conj()).sum((1, 2))) / (2 * math.pi)

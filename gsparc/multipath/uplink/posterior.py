"""What a search found of each snapshot: sources, and how wrong they may be on any aperture."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.physics.plane_waves import Aperture, Columns, delays, steering


@dataclass(frozen=True)
class Sources:
    """N sources of each of B snapshots, with the posterior of all of them together (Laplace's approximation).

    Attributes:
        direction: (B, N, 2) cosines in the array's plane.
        delay: (B, N) turns per tone.
        gain: (B, N) complex64.
        gain_spread: (B, N, N) complex64 covariance of the gains, were places known.
        place_spread: (B, 3 N, 3 N) covariance of first cosines, second cosines and delays.
        follow: (B, N, 3 N) complex64, how gains move when places do.
    """

    direction: Tensor
    delay: Tensor
    gain: Tensor
    gain_spread: Tensor
    place_spread: Tensor
    follow: Tensor

    @property
    def variance(self) -> Tensor:
        """Of the gains (B, N), were places known."""
        return torch.diagonal(self.gain_spread, dim1=1, dim2=2).real.clamp_min(0)

    @property
    def delay_variance(self) -> Tensor:
        """Of the delays (B, N), turns^2 per tone^2."""
        return torch.diagonal(self.place_spread, dim1=1, dim2=2)[:, -self.delay.shape[1] :].clamp_min(0)

    def response(self, aperture: Aperture) -> Tensor:
        """Channels (B, A, K) complex64."""
        over_antennas, over_tones = steering(self.direction, aperture), delays(self.delay, aperture)
        return (over_antennas * self.gain[..., None]).transpose(1, 2) @ over_tones

    def blur(self, aperture: Aperture) -> Tensor:
        """Expected squared error per entry (B,) of `response`, to first order in the places."""
        count = self.gain.shape[1]
        whole = Columns.of(self.direction, self.delay, aperture).gram()
        own = (whole[:, :count, :count] * self.gain_spread.transpose(1, 2)).sum((1, 2)).real
        # The places' columns are the gains following, and the slopes made loud: a Gram matrix of those.
        loud = self.gain.repeat(1, 3)
        slopes = whole[:, count:, count:] * loud[:, None] * loud.conj()[..., None]
        mixed = self.follow.mH @ (whole[:, :count, count:] * loud[:, None])
        followed = self.follow.mH @ (whole[:, :count, :count] @ self.follow)
        placed = (slopes + followed).real + 2 * mixed.real
        placed = (placed * self.place_spread).sum((1, 2))
        return (own + placed).clamp_min(0) / (len(aperture.places) * len(aperture.tones))

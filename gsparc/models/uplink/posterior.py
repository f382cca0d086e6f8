"""Sources of each snapshot with their posterior, and the expected error on any aperture."""

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
        gain_covariance: (B, N, N) complex64, given directions and delays.
        position_covariance: (B, 3 N, 3 N) covariance of first cosines, second cosines and delays.
        gain_slopes: (B, N, 3 N) complex64, derivative of gains by directions and delays.
    """

    direction: Tensor
    delay: Tensor
    gain: Tensor
    gain_covariance: Tensor
    position_covariance: Tensor
    gain_slopes: Tensor

    @property
    def variance(self) -> Tensor:
        """Of the gains (B, N), given directions and delays."""
        return torch.diagonal(self.gain_covariance, dim1=1, dim2=2).real.clamp_min(0)

    @property
    def delay_variance(self) -> Tensor:
        """Of the delays (B, N), turns^2 per tone^2."""
        return torch.diagonal(self.position_covariance, dim1=1, dim2=2)[:, -self.delay.shape[1] :].clamp_min(
            0
        )

    def response(self, aperture: Aperture) -> Tensor:
        """Channels (B, A, K) complex64."""
        over_antennas, over_tones = steering(self.direction, aperture), delays(self.delay, aperture)
        return (over_antennas * self.gain[..., None]).transpose(1, 2) @ over_tones

    def error_variance(self, aperture: Aperture) -> Tensor:
        """Expected squared error per entry (B,) of `response`, to first order in the places."""
        count = self.gain.shape[1]
        gram = Columns.of(self.direction, self.delay, aperture).gram()
        own = (gram[:, :count, :count] * self.gain_covariance.transpose(1, 2)).sum((1, 2)).real
        # Derivatives by directions and delays: of the gains, and of the steering vectors times the gains.
        gains = self.gain.repeat(1, 3)
        slopes = gram[:, count:, count:] * gains[:, None] * gains.conj()[..., None]
        mixed = self.gain_slopes.mH @ (gram[:, :count, count:] * gains[:, None])
        from_gains = self.gain_slopes.mH @ (gram[:, :count, :count] @ self.gain_slopes)
        from_positions = (slopes + from_gains).real + 2 * mixed.real
        from_positions = (from_positions * self.position_covariance).sum((1, 2))
        return (own + from_positions).clamp_min(0) / (len(aperture.places) * len(aperture.tones))

"""Sources of a snapshot by greedy search on a grid, each round followed by a joint refinement off it.

Newtonised matching pursuit (Mamandipoor, Ramasamy, Madhow 2016) with gains under a sparse Bayesian prior
(Tipping 2001), refined by variable projection (Golub and Pereyra 1973): directions and delays take
Gauss-Newton steps on what the best gains leave unexplained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from gsparc.uplink.atoms import Aperture, Sources, delays, gram, inner, steering

LEAST_SHARE = 1e-7  # of a snapshot's power that a source's prior keeps, so that nothing divides by zero
LARGEST_STEP = (0.06, 0.012)  # of direction cosines and of delays, a fraction of a resolution cell
REACH = (0.03, 0.006)  # standard deviation of a step before anything is known: half a step of the grid


@dataclass(frozen=True)
class SearchSettings:
    """How sources are looked for.

    Attributes:
        rounds: of looking at what is left over.
        picks: new sources a round.
        refinements: joint steps after each round.
        final: joint steps at the end.
        oversampling: grid points per resolution cell of the array and of the band.
        delay_window: first and last delay, turns per tone, about the snapshot's mean delay.
        leakage: share of a snapshot's power that is not explained by sources (hardware, drift).
    """

    rounds: int = 5
    picks: int = 4
    refinements: int = 1
    final: int = 3
    oversampling: float = 1.5
    delay_window: tuple[float, float] = (-0.12, 0.30)
    leakage: float = 3e-4


class SourceSearch:
    """Finds the sources of snapshots measured on one aperture.

    Args:
        aperture: antennas and tones.
        settings: see there.
    """

    def __init__(self, aperture: Aperture, settings: SearchSettings) -> None:
        self.aperture, self.settings = aperture, settings
        self.cosines, self.delays, self.shape = _grid(aperture, settings)
        self._over_antennas = steering(self.cosines[None], aperture)[0].conj()
        self._over_tones = delays(self.delays[None], aperture)[0].conj().T.contiguous()
        self._turning = 2j * math.pi * aperture.places
        self._delaying = -2j * math.pi * aperture.tones

    def __call__(self, snapshot: Tensor, noise: Tensor) -> tuple[Sources, Tensor]:
        """Sources of snapshots (B, A, K) complex64 of noise power (B,); also what is left, (B, A, K)."""
        s = self.settings
        power = snapshot.abs().square().mean((1, 2))
        scale = power.sqrt().clamp_min(1e-30)
        y, noise = snapshot / scale[:, None, None], noise / power.clamp_min(1e-30) + s.leakage
        count = len(snapshot)
        direction, delay = snapshot.real.new_zeros(count, 0, 2), snapshot.real.new_zeros(count, 0)
        prior, left = delay, y
        for turn in range(s.rounds):
            new_direction, new_delay = self._peaks(left)
            direction, delay = torch.cat([direction, new_direction], 1), torch.cat([delay, new_delay], 1)
            prior = torch.cat([prior, torch.full_like(new_delay, 1 / (s.rounds * s.picks))], 1)
            last = turn == s.rounds - 1
            for _ in range(s.refinements + (s.final if last else 0)):
                direction, delay, prior, left = self._step(y, noise, direction, delay, prior)
        fit = self._fit(y, noise, direction, delay, prior)
        found = Sources(
            direction,
            delay,
            fit.gain * scale[:, None],
            fit.variance * power[:, None],
            self._certainty(fit, noise),
        )
        return found, fit.left * scale[:, None, None]

    def _peaks(self, left: Tensor) -> tuple[Tensor, Tensor]:
        """The strongest local maxima of the correlation with the grid's atoms."""
        score = (self._over_antennas @ left @ self._over_tones).abs()
        cube = score.view(-1, 1, *self.shape)
        peaks = torch.where(max_pool3d(cube, 3, 1, 1) == cube, cube, torch.zeros_like(cube)).flatten(1)
        at = peaks.topk(self.settings.picks, 1).indices
        return self.cosines[at // len(self.delays)], self.delays[at % len(self.delays)]

    def _fit(self, y: Tensor, noise: Tensor, direction: Tensor, delay: Tensor, prior: Tensor) -> _Fit:
        """Best gains of given sources, and what they leave."""
        a, t = steering(direction, self.aperture), delays(delay, self.aperture)
        own = gram(a, t, a, t)
        torch.diagonal(own, dim1=1, dim2=2).add_((noise[:, None] / prior).to(y.dtype))
        inverse = torch.linalg.inv(own)
        gain = (inverse @ inner(a, t, y)[..., None])[..., 0]
        variance = noise[:, None] * torch.diagonal(inverse, dim1=1, dim2=2).real
        return _Fit(a, t, gain, variance, inverse, y - (a * gain[..., None]).transpose(1, 2) @ t)

    def _step(
        self, y: Tensor, noise: Tensor, direction: Tensor, delay: Tensor, prior: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A Gauss-Newton step of directions and delays on what the best gains leave."""
        fit = self._fit(y, noise, direction, delay, prior)
        over_antennas, over_tones = self._slopes(fit)
        slope = inner(over_antennas, over_tones, fit.left).real
        n = delay.shape[1]
        reach = self._reach(n)
        factor, _ = torch.linalg.cholesky_ex(self._curvature(fit, over_antennas, over_tones, noise))
        step = torch.cholesky_solve((slope * reach)[..., None], factor)[..., 0] * reach
        turned = step[:, : 2 * n].view(-1, 2, n).transpose(1, 2).clamp(-LARGEST_STEP[0], LARGEST_STEP[0])
        moved = step[:, 2 * n :].clamp(-LARGEST_STEP[1], LARGEST_STEP[1])
        prior = (fit.gain.abs().square() + fit.variance).clamp_min(LEAST_SHARE)
        return direction + turned, delay + moved, prior, fit.left

    def _certainty(self, fit: _Fit, noise: Tensor) -> Tensor:
        """Variance of the delays (B, N); half the noise is in the real part."""
        n = fit.gain.shape[1]
        factor, _ = torch.linalg.cholesky_ex(self._curvature(fit, *self._slopes(fit), noise))
        spread = torch.diagonal(torch.cholesky_inverse(factor), dim1=1, dim2=2)[:, 2 * n :]
        return (spread * (noise[:, None] / 2)).clamp_min(0) * self._reach(n)[2 * n :] ** 2

    def _slopes(self, fit: _Fit) -> tuple[Tensor, Tensor]:
        """Derivatives of the heard sources by both cosines and the delay: (B, 3 N, A) and (B, 3 N, K)."""
        loud = fit.antennas * fit.gain[..., None]
        x, y = self._turning[:, 0], self._turning[:, 1]
        return torch.cat([loud * x, loud * y, loud], 1), torch.cat(
            [fit.tones, fit.tones, fit.tones * self._delaying], 1
        )

    def _curvature(self, fit: _Fit, over_antennas: Tensor, over_tones: Tensor, noise: Tensor) -> Tensor:
        """(B, 3 N, 3 N) of the projected problem, in units of `_reach`, with the prior of a small step."""
        cross = gram(over_antennas, over_tones, fit.antennas, fit.tones)
        whole = gram(over_antennas, over_tones, over_antennas, over_tones)
        projected = (whole - cross @ fit.inverse @ cross.transpose(1, 2).conj()).real
        reach = self._reach(fit.gain.shape[1])
        scaled = projected * reach[:, None] * reach
        torch.diagonal(scaled, dim1=1, dim2=2).add_(noise[:, None])
        return scaled

    def _reach(self, count: int) -> Tensor:
        """Standard deviations (3 N,) of a step before anything is known."""
        return torch.cat([torch.full((2 * count,), REACH[0]), torch.full((count,), REACH[1])])


@dataclass(frozen=True)
class _Fit:
    """Sources' atoms (B, N, A), (B, N, K), gains and variances (B, N), inverse Gram matrix, residual."""

    antennas: Tensor
    tones: Tensor
    gain: Tensor
    variance: Tensor
    inverse: Tensor
    left: Tensor


def _grid(aperture: Aperture, s: SearchSettings) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """Cosines (G, 2), delays (T,), and the shape of both together; one cosine where the array is a line."""
    axes = []
    for axis in range(2):
        extent = float(aperture.places[:, axis].max() - aperture.places[:, axis].min())
        cells = max(1, round(2 * s.oversampling * (extent * 2 + 1) / 2)) if extent > 1e-6 else 1
        axes.append((torch.arange(cells) + 0.5) / cells * 2 - 1)
    step = 1 / (len(aperture.tones) * s.oversampling)
    found = torch.arange(s.delay_window[0], s.delay_window[1], step)
    cosines = torch.cartesian_prod(*axes)
    return cosines, found, (len(axes[0]), len(axes[1]), len(found))

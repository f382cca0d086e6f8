"""Sources of a snapshot by greedy search on a grid, each round followed by a joint refinement off it.

Newtonised matching pursuit (Mamandipoor, Ramasamy, Madhow 2016) with gains under a sparse Bayesian prior
(Tipping 2001), refined by variable projection (Golub and Pereyra 1973): directions and delays take
Gauss-Newton steps on what the best gains leave unexplained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from gsparc.uplink.atoms import Aperture, Sources, delays, gram, inner, phasor, steering

LEAST_SHARE = 1e-7  # of a snapshot's power that a source's prior keeps, so that nothing divides by zero
LARGEST_STEP = (0.06, 0.012)  # of direction cosines and of delays, a fraction of a resolution cell


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

    rounds: int = 8
    picks: int = 4
    refinements: int = 1
    final: int = 6
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
                direction, delay, prior, left, _ = self._step(y, noise, direction, delay, prior)
        *_, left, found = self._step(y, noise, direction, delay, prior)
        found = replace(found, gain=found.gain * scale[:, None], variance=found.variance * power[:, None])
        return found, left * scale[:, None, None]

    def _peaks(self, left: Tensor) -> tuple[Tensor, Tensor]:
        """The strongest local maxima of the correlation with the grid's atoms."""
        score = (self._over_antennas @ left @ self._over_tones).abs()
        cube = score.view(-1, 1, *self.shape)
        peaks = torch.where(max_pool3d(cube, 3, 1, 1) == cube, cube, torch.zeros_like(cube)).flatten(1)
        at = peaks.topk(self.settings.picks, 1).indices
        return self.cosines[at // len(self.delays)], self.delays[at % len(self.delays)]

    def _step(
        self, y: Tensor, noise: Tensor, direction: Tensor, delay: Tensor, prior: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Sources]:
        """Best gains, what they leave, and a Gauss-Newton step of directions and delays."""
        a, t = steering(direction, self.aperture), delays(delay, self.aperture)
        own = gram(a, t, a, t) + torch.diag_embed((noise[:, None] / prior).to(y.dtype))
        inverse = torch.linalg.inv(own)
        gain = (inverse @ inner(a, t, y)[..., None])[..., 0]
        variance = noise[:, None] * torch.diagonal(inverse, dim1=1, dim2=2).real
        left = y - (a * gain[..., None]).transpose(1, 2) @ t
        step, certainty = self._slope(a, t, gain, inverse, left, noise)
        found = Sources(direction, delay, gain, variance, certainty)
        n = delay.shape[1]
        turned = step[:, : 2 * n].view(-1, 2, n).transpose(1, 2).clamp(-LARGEST_STEP[0], LARGEST_STEP[0])
        moved = step[:, 2 * n :].clamp(-LARGEST_STEP[1], LARGEST_STEP[1])
        prior = (gain.abs().square() + variance).clamp_min(LEAST_SHARE)
        return direction + turned, delay + moved, prior, left, found

    def _slope(
        self, a: Tensor, t: Tensor, gain: Tensor, inverse: Tensor, left: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Step (B, 3 N) of both cosines and the delay, and the delays' variance (B, N)."""
        turn = 2j * math.pi
        places, tones = self.aperture.places, self.aperture.tones
        loud = a * gain[..., None]
        over_antennas = torch.cat([loud * (turn * places[:, 0]), loud * (turn * places[:, 1]), loud], 1)
        over_tones = torch.cat([t, t, t * (-turn * tones)], 1)
        # A step is small before it is large: its scale is the grid's half step.
        n = gain.shape[1]
        reach = torch.cat([gain.real.new_full((2 * n,), 0.03), gain.real.new_full((n,), 0.006)])
        cross = gram(over_antennas, over_tones, a, t)
        curvature = (gram(over_antennas, over_tones, over_antennas, over_tones)
                     - cross @ inverse @ cross.transpose(1, 2).conj()).real  # fmt: skip
        scaled = curvature * reach[:, None] * reach + torch.diag_embed(noise[:, None].expand(-1, 3 * n))
        slope = inner(over_antennas, over_tones, left).real * reach
        # Half the noise is in the real part.
        spread = torch.linalg.inv(scaled)
        step = (spread @ slope[..., None])[..., 0] * reach
        certainty = torch.diagonal(spread, dim1=1, dim2=2)[:, 2 * n :] * (noise[:, None] / 2)
        return step, certainty.clamp_min(0) * reach[2 * n :] ** 2


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


__all__ = ["SearchSettings", "SourceSearch", "phasor"]

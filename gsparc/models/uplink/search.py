"""Sources of a snapshot by greedy search on a grid,
each round followed by a joint refinement off it.

Newtonised matching pursuit (Mamandipoor, Ramasamy, Madhow 2016) with gains under a sparse Bayesian
prior (Tipping 2001), refined by variable projection (Golub and Pereyra 1973): directions and delays
take Gauss-Newton steps on what the best gains leave unexplained.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.base.limits import internal
from gsparc.models.uplink.interface import mean_power
from gsparc.physics.plane_waves import Aperture, SourceColumns, antenna_responses, tone_responses
from gsparc.processes.factor import Factor

# Of a snapshot's power, lower bound of a source's prior against division by zero
LEAST_SHARE = 1e-7
# Of a round's residual that counts as noise: sources not found yet bias those found
UNEXPLAINED = 0.2
# Prior standard deviation of a step of cosines, and of delays: half a step of the grid
REACH = (0.03, 0.006)
LARGEST = 2  # of these deviations, that a step may have


def repeat_per_coordinate(gain: Tensor) -> Tensor:
    """Return gains (B, N) once for each coordinate of their sources, (B, 3 N):
    two cosines and a delay.
    """
    return gain.repeat(1, 3)


@dataclass(frozen=True)
class Sources:
    """N sources of each of B snapshots, with the posterior of all
    of them together (Laplace's approximation).

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
        """Variance of the gains (B, N), given directions and delays."""
        return torch.diagonal(self.gain_covariance, dim1=1, dim2=2).real.clamp_min(0)

    @property
    def delay_variance(self) -> Tensor:
        """Variance of the delays (B, N), turns^2 per tone^2."""
        variance = torch.diagonal(self.position_covariance, dim1=1, dim2=2)
        return variance[:, -self.delay.shape[1] :].clamp_min(0)

    def channels(self, aperture: Aperture) -> Tensor:
        """Return channels (B, A, K) complex64."""
        over_antennas = antenna_responses(self.direction, aperture)
        over_tones = tone_responses(self.delay, aperture)
        return (over_antennas * self.gain[..., None]).transpose(1, 2) @ over_tones

    def error_variance(self, aperture: Aperture) -> Tensor:
        """Return the expected squared error per entry (B,) of `response`,
        to first order in the places.
        """
        count = self.gain.shape[1]
        gram = SourceColumns.from_sources(self.direction, self.delay, aperture).gram()
        gain_variance = (
            (gram[:, :count, :count] * self.gain_covariance.transpose(1, 2)).sum((1, 2)).real
        )
        # Derivatives by directions and delays: of the gains,
        # and of the steering vectors times the gains.
        gains = repeat_per_coordinate(self.gain)
        slopes = gram[:, count:, count:] * gains[:, None] * gains.conj()[..., None]
        mixed = self.gain_slopes.mH @ (gram[:, :count, count:] * gains[:, None])
        from_gains = self.gain_slopes.mH @ (gram[:, :count, :count] @ self.gain_slopes)
        from_positions = (slopes + from_gains).real + 2 * mixed.real
        from_positions = (from_positions * self.position_covariance).sum((1, 2))
        return (gain_variance + from_positions).clamp_min(0) / (
            len(aperture.places) * len(aperture.tones)
        )


@dataclass(frozen=True)
class SearchSettings:
    """Source search.

    Attributes:
        rounds: of matching pursuit.
        picks: new sources a round.
        refinements: joint steps after each round.
        final: joint steps at the end.
        oversampling: grid points per resolution cell of the array and of the band.
        delay_window: first and last delay, turns per tone, about the snapshot's mean delay.
        leakage: share of a snapshot's power that is not explained by sources (hardware, drift).
    """

    rounds: int = 6
    picks: int = 3
    refinements: int = 1
    final: int = 2
    oversampling: float = 1.5
    delay_window: tuple[float, float] = internal((-0.12, 0.30))
    leakage: float = 3e-4


class SourceSearch:
    """Finds the sources of snapshots measured on one aperture.

    Args:
        aperture: antennas and tones.
        settings: see there.
    """

    def __init__(self, aperture: Aperture, settings: SearchSettings) -> None:
        self.aperture, self.settings = aperture, settings
        self.cosines, self.delays, self.shape = _make_grid(aperture, settings)
        self._over_antennas = antenna_responses(self.cosines[None], aperture)[0].conj()
        self._over_tones = tone_responses(self.delays[None], aperture)[0].conj().T.contiguous()

    def __call__(self, snapshot: Tensor, noise: Tensor) -> tuple[Sources, Tensor]:
        """Sources of snapshots (B, A, K) complex64 of noise power (B,),
        and the residual (B, A, K).
        """
        s = self.settings
        heard = mean_power(snapshot)
        scale = heard.sqrt()
        y, noise = snapshot / scale[:, None, None], noise / heard + s.leakage
        count = len(snapshot)
        direction, delay = snapshot.real.new_zeros(count, 0, 2), snapshot.real.new_zeros(count, 0)
        prior, residual = delay, y
        for turn in range(s.rounds):
            new_direction, new_delay = self._peak_directions_and_delays(residual)
            direction, delay = (
                torch.cat([direction, new_direction], 1),
                torch.cat([delay, new_delay], 1),
            )
            # Unit power in equal shares of all sources that there will be.
            prior = torch.cat([prior, torch.full_like(new_delay, 1 / (s.rounds * s.picks))], 1)
            last = turn == s.rounds - 1
            inflated_noise = noise + UNEXPLAINED * residual.abs().square().mean((1, 2))
            for _ in range(s.refinements + (s.final if last else 0)):
                fit = self._fit_gains(y, inflated_noise, direction, delay, prior)
                turned, moved = self._step_directions_and_delays(fit, inflated_noise)
                direction, delay = direction + turned, delay + moved
                # Tipping's update: a gain that noise explains shrinks its own prior,
                # and with it its source.
                prior = (fit.gain.abs().square() + fit.variance(inflated_noise)).clamp_min(
                    LEAST_SHARE
                )
            if not last:
                residual = y - fit.columns.channels(fit.gain)
        # What was not found yet counted as noise above; the posterior is of the known noise.
        fit = self._fit_gains(y, noise, direction, delay, prior)
        residual = scale[:, None, None] * (y - fit.columns.channels(fit.gain))
        return self._to_sources(fit, noise, direction, delay, scale), residual

    def _peak_directions_and_delays(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """The strongest local maxima of the correlation with the grid's atoms."""
        score = (
            torch.view_as_real(self._over_antennas @ (residual @ self._over_tones)).square().sum(-1)
        )
        cube = score.view(-1, *self.shape)
        peaks = torch.where(_dilate(cube) == cube, cube, 0).flatten(1)
        at = peaks.topk(self.settings.picks, 1).indices
        return self.cosines[at // len(self.delays)], self.delays[at % len(self.delays)]

    def _fit_gains(
        self, y: Tensor, noise: Tensor, direction: Tensor, delay: Tensor, prior: Tensor
    ) -> _Fit:
        """Best gains of given sources, and the gradient by their directions and delays."""
        n = delay.shape[1]
        columns = SourceColumns.from_sources(direction, delay, self.aperture)
        gram, inner = columns.gram(), columns.inner_products(y)
        torch.diagonal(gram, dim1=1, dim2=2)[:, :n].add_(noise[:, None] / prior)
        cross, inverse = gram[:, n:, :n], torch.linalg.inv(gram[:, :n, :n])
        gain = (inverse @ inner[:, :n, None])[..., 0]
        gains = repeat_per_coordinate(gain)
        slope = ((inner[:, n:] - (cross @ gain[..., None])[..., 0]) * gains.conj()).real
        gain_slopes = cross @ inverse
        # Variable projection: what other gains can make up for tells nothing of places.
        projected = gram[:, n:, n:] - gain_slopes @ cross.mH
        curvature = (projected * gains[:, None] * gains.conj()[..., None]).real
        return _Fit(columns, gain, inverse, slope, curvature, gain_slopes)

    def _step_directions_and_delays(self, fit: _Fit, noise: Tensor) -> tuple[Tensor, Tensor]:
        """A Gauss-Newton step of directions (B, N, 2) and delays (B, N)
        on the residual of the best gains.
        """
        n = fit.gain.shape[1]
        reach = self._step_deviations(n)
        factor = Factor.from_gram(self._scaled_curvature(fit, noise), "ignore")
        step = factor.solve((fit.slope * reach)[..., None])[..., 0] * reach
        step = step.clamp(-LARGEST * reach, LARGEST * reach)
        return step[:, : 2 * n].view(-1, 2, n).transpose(1, 2), step[:, 2 * n :]

    def _scaled_curvature(self, fit: _Fit, noise: Tensor) -> Tensor:
        """Curvature (B, 3 N, 3 N) in units of `_reach`, with the prior of a small step."""
        reach = self._step_deviations(fit.gain.shape[1])
        scaled = fit.curvature * (reach[:, None] * reach)
        torch.diagonal(scaled, dim1=1, dim2=2).add_(noise[:, None])
        return scaled

    def _to_sources(
        self, fit: _Fit, noise: Tensor, direction: Tensor, delay: Tensor, scale: Tensor
    ) -> Sources:
        """The sources and their posterior, in the snapshot's units;
        half the noise is in the real part.
        """
        reach = self._step_deviations(fit.gain.shape[1])
        gains = repeat_per_coordinate(fit.gain * scale[:, None])
        spread = torch.linalg.inv(self._scaled_curvature(fit, noise)) * (reach[:, None] * reach)
        return Sources(
            direction,
            delay,
            fit.gain * scale[:, None],
            fit.inverse * (noise * scale**2)[:, None, None],
            spread * (noise / 2)[:, None, None],
            -(fit.gain_slopes.mH * gains[:, None]),
        )

    def _step_deviations(self, count: int) -> Tensor:
        """Standard deviations (3 N,) of a step before anything is known."""
        return torch.cat([torch.full((2 * count,), REACH[0]), torch.full((count,), REACH[1])])


@dataclass(frozen=True)
class _Fit:
    """Gains of given sources, and the projected problem of their places (columns
    of unit gains, scaled).

    Attributes:
        columns: atoms and slopes.
        gain: (B, N).
        inverse: (B, N, N) of the regularised Gram matrix of the atoms.
        slope: (B, 3 N) downhill.
        curvature: (B, 3 N, 3 N).
        gain_slopes: (B, 3 N, N) what the slopes of unit gains have in common with the gains'
            inverse.
    """

    columns: SourceColumns
    gain: Tensor
    inverse: Tensor
    slope: Tensor
    curvature: Tensor
    gain_slopes: Tensor

    def variance(self, noise: Tensor) -> Tensor:
        """Return the variance of the gains (B, N)."""
        return noise[:, None] * torch.diagonal(self.inverse, dim1=1, dim2=2).real


def _dilate(cube: Tensor) -> Tensor:
    """The largest value within one step along every axis of cubes (B, ...)."""
    for axis in range(1, cube.ndim):
        size = cube.shape[axis] - 1
        if size:
            grown = cube.clone()
            for mine, other in ((0, 1), (1, 0)):
                part = grown.narrow(axis, mine, size)
                torch.maximum(part, cube.narrow(axis, other, size), out=part)
            cube = grown
    return cube


def _make_grid(
    aperture: Aperture, s: SearchSettings
) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """Cosines (G, 2), delays (T,), and the shape of both together;
    one cosine where the array is a line.
    """
    axes = []
    for axis in range(2):
        extent = float(aperture.places[:, axis].max() - aperture.places[:, axis].min())
        # Places are in wavelengths: cosines in [-1, 1] have 2 extent + 1 resolution cells.
        cells = max(1, round(2 * s.oversampling * (extent * 2 + 1) / 2)) if extent > 1e-6 else 1
        axes.append((torch.arange(cells) + 0.5) / cells * 2 - 1)
    step = 1 / (len(aperture.tones) * s.oversampling)
    delay_grid = torch.arange(s.delay_window[0], s.delay_window[1], step)
    cosines = torch.cartesian_prod(*axes)
    return cosines, delay_grid, (len(axes[0]), len(axes[1]), len(delay_grid))

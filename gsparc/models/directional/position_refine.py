"""Uncertain positions of triangulated sources,
refined to a fraction of a wavelength by phases of channels.

A source at an uncertain position has an unknown relative phase at receivers far apart. Averaged
over a position of covariance S, signals received in directions u and u' have the covariance of a
known position times

    exp(-|L^T (v - v')|^2 / 2),   v = 2 pi f u / c,   S = L L^T .

Sources are refined one after the other under the likelihood in which all others keep their current
position uncertainty: many positions are drawn from the triangulation's posterior, the best
are refined by Gauss-Newton steps, and a source is resolved where one optimum is clearly the best.
One with several similar optima stays uncertain until others are resolved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.models.apart import keep_apart
from gsparc.models.directional.triangulation import SAME_SIGMAS
from gsparc.models.image_sources.gp_likelihood import condition_with_noise
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import spherical_waves
from gsparc.models.image_sources.search import NOISE
from gsparc.physics.waves import LIGHT
from gsparc.processes.factor import Factor
from gsparc.processes.fit_kernel import SETTLED
from gsparc.processes.kernel import distances

JITTER_M2 = 1e-14  # [m^2], what float64 needs to factor the covariance of a position
SHARP_RAD = 0.1  # standard deviation of relative phases below which a position counts as exact
DRAWS_PER_CELL, MIN_DRAWS, MAX_DRAWS = 6, 32, 768  # positions per cell of the prior, in all
CELL = 1 / 4  # of a wavelength
REFINED, STEPS = 6, 8  # best draws, and Gauss-Newton steps for each
MIN_PROBABILITY = 0.8  # of one optimum, to resolve a source
SWEEPS = 8  # over all sources
MIN_NOISE = 1e-3  # of the rows' power
POWER_UPDATES, MAX_RATIO = 3, 8.0  # fixed-point iterations, and largest change in each
MAX_POWER = 4.0  # of a source, times the median
TINY = 1e-9  # of a power: one of 0 would stay 0 for ever, as every update is proportional to it


@dataclass(frozen=True)
class UncertainPositions:
    """K sources with Gaussian position uncertainty.

    Attributes:
        points: (K, 3) float64 [m].
        covariance: (K, 3, 3) float64 [m^2].
    """

    points: Tensor
    covariance: Tensor

    @cached_property
    def covariance_factors(self) -> Tensor:
        """(K, 3, 3), Cholesky factors of the covariances."""
        jitter = torch.full_like(self.points, JITTER_M2).diag_embed()
        return Factor.from_gram(self.covariance + jitter, "raise").lower

    def phase_vectors(
        self, places: Tensor, frequency: Tensor, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        """Return (K, n, 3) [rad], `L^T v` for places (n, 3) [m] and frequencies (n,) or () [Hz]."""
        slope = wave_vectors(self.points, places, frequency)
        return (slope @ self.covariance_factors).to(dtype)

    def select(self, index: Tensor) -> UncertainPositions:
        """Return a subset of the sources."""
        return UncertainPositions(self.points[index], self.covariance[index])

    def incoherent(self, places: Tensor, frequency: Tensor) -> Tensor:
        """Return indices of the sources that are not coherent over these places."""
        phase_vectors = self.phase_vectors(places, frequency)
        spread = (
            (phase_vectors - phase_vectors.mean(1, keepdim=True)).square().sum(-1).amax(1).sqrt()
        )
        return torch.nonzero(spread > SHARP_RAD).flatten()


def wave_vectors(points: Tensor, places: Tensor, frequency: Tensor) -> Tensor:
    """Return gradients (K, n, 3) float64 [rad/m] of received phases by sources' positions,
    up to a sign.
    """
    hertz = torch.as_tensor(frequency, dtype=torch.float64).reshape(-1, 1)
    return normalize(points[:, None] - places[None], dim=-1) * (2 * math.pi / LIGHT * hertz)


def coherence(first: Tensor, second: Tensor) -> Tensor:
    """Return (K, m, n), of `phase_vectors` (K, m, 3) and (K, n, 3)."""
    return distances(first, second).square().mul_(-0.5).exp_()


@dataclass
class PositionRefinement:
    """Positions from the triangulation's posterior to that of rays and channels.

    Attributes:
        rows: of unit power.
        visible: (n, K) float32, of each row's receiver.
        prior: by triangulation.
        correlation: (n, n) float32, correlation of gains.
    """

    rows: Rows
    visible: Tensor
    prior: UncertainPositions
    correlation: Tensor
    seed: int = 0

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)
        self.current, self.noise = self.prior, NOISE
        self.wavelength = LIGHT / float(self.rows.frequency.mean())

    def run(self) -> UncertainPositions:
        """Return positions and covariances given rays and channels."""
        uncertain = self.prior.incoherent(self.rows.position, self.rows.frequency)
        if not len(uncertain):
            return self.current  # directions were exact: nothing to refine
        self.terms = torch.stack(
            [self._source_covariance(k) for k in range(len(self.prior.points))]
        )
        mean_power = float(self.terms.diagonal(dim1=1, dim2=2).real.sum(0).mean())
        self.power = torch.full((len(self.terms),), 1 / max(mean_power, TINY))
        self.resolved = torch.zeros(len(self.terms), dtype=torch.bool)
        size = torch.linalg.det(self.prior.covariance)
        order = uncertain[size[uncertain].argsort()].tolist()
        lowest = math.inf
        for _ in range(SWEEPS):
            if lowest - (nll := self._update_powers()) < SETTLED:
                break
            lowest = nll
            for k in order:
                self._refine_source(k)
        return self.current

    def _source_covariance(self, k: int) -> Tensor:
        """Covariance (n, n) of the rows by source k of unit power."""
        one = self.current.select(torch.tensor([k]))
        wave = spherical_waves(self.rows, one.points)[:, 0] * self.visible[:, k]
        phase_vectors = one.phase_vectors(self.rows.position, self.rows.frequency)
        return (
            wave[:, None]
            * wave.conj()
            * (self.correlation * coherence(phase_vectors, phase_vectors)[0])
        )

    def sum_source_covariances(self, without: int | None = None) -> Tensor:
        """Return the covariance (n, n) of the rows by all sources but one."""
        power = self.power.to(self.terms.dtype)
        if without is not None:  # a difference of covariances need not be positive definite
            power[without] = 0
        return (power @ self.terms.flatten(1)).unflatten(0, self.terms.shape[1:])

    def _update_powers(self) -> float:
        """Powers and noise by the fixed point of D. J. C. MacKay ("Bayesian interpolation", 1992).

        Returns the negative log likelihood before the last update.
        """
        outputs = self.rows.target.shape[1]
        for _ in range(POWER_UPDATES):
            solution = condition_with_noise(
                self.sum_source_covariances(), self.noise, self.rows.target
            )
            explained = (solution.weights.conj() * (self.terms @ solution.weights)).real.sum((1, 2))
            due = outputs * (solution.factor.inverse.conj() * self.terms).real.sum((1, 2))
            self.power = self.power * (explained / due.clamp_min(TINY)).clamp(
                1 / MAX_RATIO, MAX_RATIO
            )
            self.power = self.power.clamp_max(MAX_POWER * float(self.power.median())).clamp_min(
                TINY
            )
            residual = float(solution.weights.abs().square().sum())
            ratio = residual / (outputs * float(solution.factor.inverse.diagonal().real.sum()))
            self.noise = max(self.noise * min(max(ratio, 1 / MAX_RATIO), MAX_RATIO), MIN_NOISE)
        return solution.nll

    def _refine_source(self, k: int) -> None:
        """Position and covariance of source k given its rays,
        the channels and all other sources.
        """
        conditional = ConditionalLikelihood(self, k)
        if self.resolved[k]:
            places = self.current.points[k][None]
        else:
            places = conditional.select_separated(
                self._draw_positions(k), CELL / 2 * self.wavelength
            )
        places, spreads = conditional.refine(places)
        log_posterior = conditional.log_posterior(places) + 0.5 * torch.linalg.slogdet(spreads)[1]
        best = int(log_posterior.argmax())
        offset = places - places[best]
        same = ((offset @ torch.linalg.inv(spreads[best])) * offset).sum(1) < SAME_SIGMAS**2
        same |= offset.norm(dim=1) < CELL / 2 * self.wavelength
        if (
            1 / (1 + float((log_posterior[~same] - log_posterior[best]).exp().sum()))
            < MIN_PROBABILITY
        ):
            return
        points, covariance = self.current.points.clone(), self.current.covariance.clone()
        points[k], covariance[k], self.resolved[k] = places[best], spreads[best], True
        self.current = UncertainPositions(points, covariance)
        self.terms[k] = self._source_covariance(k)

    def _draw_positions(self, k: int) -> Tensor:
        """Draws (m, 3) from the prior of source k, its mean first."""
        width = torch.linalg.eigvalsh(self.prior.covariance[k]).clamp_min(0).sqrt()
        cells = float((1 + SAME_SIGMAS * width / (CELL * self.wavelength)).prod())
        count = int(min(max(DRAWS_PER_CELL * cells, MIN_DRAWS), MAX_DRAWS))
        draw = torch.randn(count, len(width), generator=self.generator, dtype=width.dtype)
        draw[0] = 0
        return self.prior.points[k] + draw @ self.prior.covariance_factors[k].T


class ConditionalLikelihood:
    """Likelihood of the position of source k given all others, at the n rows that see it.

    Attributes:
        rows: these.
        inverse: (n, n), of their covariance by the others and noise.
        alpha: (n, R), its product with the targets.
        power: of the source.
        centre, precision: mean (3,) [m] and inverse covariance (3, 3) of its prior.
    """

    def __init__(self, refinement: PositionRefinement, k: int) -> None:
        rows, prior = refinement.rows, refinement.prior
        solution = condition_with_noise(
            refinement.sum_source_covariances(k), refinement.noise, rows.target
        )
        in_view = torch.nonzero(refinement.visible[:, k] > 0).flatten()
        self.rows, self.alpha = rows.select_rows(in_view), solution.weights[in_view]
        self.inverse = solution.factor.inverse[in_view[:, None], in_view]
        self.power, self.centre = float(refinement.power[k]), prior.points[k]
        self.precision = torch.linalg.inv(prior.covariance[k])

    def log_posterior(self, points: Tensor) -> Tensor:
        """Log posterior (m,) float64 of places (m, 3), up to a constant."""
        waves = spherical_waves(self.rows, points)
        matched = (waves.mH @ self.alpha).abs().square().sum(1)
        scale = 1 + self.power * (waves.conj() * (self.inverse @ waves)).real.sum(0)
        offset = points - self.centre
        rays = 0.5 * ((offset @ self.precision) * offset).sum(1)
        return (self.power * matched / scale - self.alpha.shape[1] * scale.log()).double() - rays

    def select_separated(self, points: Tensor, distance: float) -> Tensor:
        """Return the best `REFINED` of positions (m, 3),
        at least `distance` [m] from each other.
        """
        order = self.log_posterior(points).argsort(descending=True).tolist()
        near = torch.cdist(points, points) < distance
        return points[keep_apart(order, lambda i, j: bool(near[i, j]), REFINED)]

    def refine(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions (m, 3) after Gauss-Newton steps at the best gain,
        and covariances (m, 3, 3).
        """
        best, step_scale = self.log_posterior(points), torch.ones(len(points), dtype=torch.float64)
        for _ in range(STEPS):
            step, _ = self._steps_and_covariances(points)
            trial_points = points + step_scale[:, None] * step
            log_posterior = self.log_posterior(trial_points)
            better = log_posterior > best
            points = torch.where(better[:, None], trial_points, points)
            best = torch.where(better, log_posterior, best)
            step_scale = torch.where(better, 1.0, step_scale / 3)
        return points, self._steps_and_covariances(points)[1]

    def _steps_and_covariances(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Gauss-Newton steps (m, 3) at positions (m, 3), and covariances (m, 3, 3)
        by Fisher information.
        """
        waves = spherical_waves(self.rows, points)  # (n, m)
        whitened = self.inverse @ waves
        gain_precision = (waves.conj() * whitened).real.sum(0) + 1 / self.power
        gain = (waves.mH @ self.alpha) / gain_precision[:, None]  # (m, R)
        # (m, n, 3)
        phase_vectors = wave_vectors(points, self.rows.position, self.rows.frequency).float()
        slope = waves.T[:, :, None] * phase_vectors * -1j
        along = torch.einsum("nm,mnc->mc", whitened.conj(), slope)
        visible = (
            self.inverse @ slope
            - whitened.T[:, :, None] * (along / gain_precision[:, None])[:, None]
        )
        power = gain.abs().square().sum(1)[:, None, None]
        fisher = 2 * (power * (slope.mH @ visible).real).double()
        residual = self.alpha - whitened.T[:, :, None] * gain[:, None]  # K^-1 (y - a g), (m, n, R)
        pull = 2 * torch.einsum("mnc,mnr,mr->mc", slope.conj(), residual, gain.conj()).real.double()
        pull = pull - (points - self.centre) @ self.precision
        covariance = torch.linalg.inv(fisher + self.precision)
        return torch.einsum("mcd,md->mc", covariance, pull), covariance

"""Gains of sources at known places, given who sees which: one regression of the channels.

    h(x, f) = sum_k m_k(x) g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,   m_k(x) in {0, 1}

with m known at the receivers and a probability elsewhere. The gains are circular Gaussian processes
as in `image_sources.gp_likelihood`, nearly constant over places. All share one correlation over
places, so that the covariance of n rows is one product of waves however many sources there are, and
a query's correlations are those of one kernel;
what is uncertain of a source's place multiplies its own part (`coherence`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import torch
from torch import Tensor

from gsparc.models.directional.position_refine import TINY, UncertainPositions, coherence
from gsparc.models.directional.visibility import VisibilityGP
from gsparc.models.image_sources.gp_likelihood import condition_with_noise
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import spherical_waves
from gsparc.models.predicting import to_double
from gsparc.physics.waves import point_wave, ranges
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.kernel import distances
from gsparc.processes.left_out import rows_of_groups
from gsparc.processes.matern import matern32_of_squares

CONSTANTS = (0.9, 0.97, 0.995)  # share of a gain's variance that is the same everywhere
LENGTHS_M = (0.5, 2.0)  # over which the rest of it varies
NOISES = (0.001, 0.01, 0.05)  # of the rows' power
ROUNDS = 4  # of expectation maximisation of powers, and choice of the kernel


@dataclass(frozen=True)
class GainKernel:
    """Covariance of gains over places.

    Attributes:
        constant: share of the variance that is the same everywhere.
        length: of the rest [m].
        noise: variance, in units of the rows' power.
    """

    constant: float
    length: float
    noise: float

    def correlation(
        self, first: Tensor, second: Tensor, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        """Return the correlation (n, m) of places (n, 3) and (m, 3) float64 [m]."""
        squared = (distances(first, second) / self.length).square()
        return (self.constant + (1 - self.constant) * matern32_of_squares(squared)).to(dtype)


KERNELS = tuple(GainKernel(*numbers) for numbers in product(CONSTANTS, LENGTHS_M, NOISES))


@dataclass(frozen=True)
class Arrival:
    """Where channels are asked for, and what depends on geometry alone.

    Attributes:
        away: (m, K) float64 [m], ranges to the sources.
        probability: (m, K), of seeing them.
        correlation: (m, n), of gains with the rows'.
        retained: (K', m, n), coherence retained under position uncertainty, of uncertain sources.
    """

    away: Tensor
    probability: Tensor
    correlation: Tensor
    retained: Tensor


@dataclass(frozen=True)
class SightedSources:
    """Posterior of the gains of K sources given n rows.

    Attributes:
        rows: in the frame.
        observer: (n,) int64, number of each row's receiver in `visibility`.
        positions: of the sources.
        visibility: of the sources, at receivers and elsewhere.
        power: (K,) of the gains, before any row.
        kernel: of all gains.
    """

    rows: Rows
    observer: Tensor
    positions: UncertainPositions
    visibility: VisibilityGP
    power: Tensor
    kernel: GainKernel

    @property
    def seen_by_rows(self) -> Tensor:
        """(n, K) float32 of zeros and ones."""
        return self.visibility.seen[self.observer].float()

    @property
    def unobstructed_waves(self) -> Tensor:
        """Waves (n, K) complex64 of the sources at every row, seen or not."""
        return spherical_waves(self.rows, self.positions.points)

    @cached_property
    def waves(self) -> Tensor:
        """The same, zero where a receiver does not see a source."""
        return self.unobstructed_waves * self.seen_by_rows

    @cached_property
    def incoherent(self) -> Tensor:
        """Indices (K',) of the sources that are not coherent over the rows."""
        return self.positions.incoherent(self.rows.position, self.rows.frequency)

    @cached_property
    def phase_vectors(self) -> Tensor:
        """(K', n, 3) of uncertain sources, see `UncertainPositions.phase_vectors`."""
        return self.positions.select(self.incoherent).phase_vectors(
            self.rows.position, self.rows.frequency
        )

    @cached_property
    def conditioned(self) -> Conditioned:
        """The rows given their covariance, which is factored in float64."""
        exact = to_double(replace(self))
        # Of all sources: gigabytes
        one_by_one = (coherence(phase_vector, phase_vector) for phase_vector in exact.phase_vectors)
        covariance = exact._cross_covariance(exact.waves, one_by_one, exact.power)
        covariance *= exact._gain_correlation(self.kernel)
        return condition_with_noise(covariance, self.kernel.noise, exact.rows.target).in_float32

    @cached_property
    def dual_weights(self) -> Tensor:
        """(n, K, R, 2), real and imaginary: what each row adds to each source's gain."""
        weights = (self.power * self.waves.conj())[:, :, None] * self.conditioned.weights[:, None]
        return torch.view_as_real(weights).contiguous()

    @cached_property
    def in_float64(self) -> SightedSources:
        """The same in float64, of what was computed in float32."""
        return to_double(self.precompute())

    def precompute(self) -> SightedSources:
        """Return itself, with what all queries need;
        what the first makes might be for inference only.
        """
        assert len(self.dual_weights) == len(self.rows)
        return self

    def fit_powers_and_kernel(self) -> SightedSources:
        """Return powers by expectation maximisation and the kernel by likelihood on a grid,
        in turn.
        """
        mean_power = float(self.waves.abs().square().sum(1).mean())
        # Equal powers to begin with, which add up to the rows' unit power.
        power, kernel = torch.full((self.waves.shape[1],), 1 / max(mean_power, TINY)), self.kernel
        coherent, correlation = (
            self._coherence(),
            {each: self._gain_correlation(each) for each in KERNELS},
        )
        for _ in range(ROUNDS):
            covariance = self._cross_covariance(self.waves, coherent, power)
            fits = {
                each: condition_with_noise(covariance * shared, each.noise, self.rows.target)
                for each, shared in correlation.items()
            }
            kernel, conditioned = min(fits.items(), key=lambda one: one[1].nll)
            # E |g_k|^2 of the constant part, over outputs (Rasmussen
            # and Williams, eq. 2.25 and 2.26)
            prior = power * kernel.constant
            mean = prior[:, None] * (self.waves.mH @ conditioned.weights)
            information = (conditioned.factor.root @ self.waves).abs().square().sum(0)
            power = (mean.abs().square().mean(1) + prior - prior.square() * information).clamp_min(
                TINY
            )
        return replace(self, power=power, kernel=kernel)

    def arrival_at(
        self, places: Tensor, frequency: Tensor, probability: Tensor | None = None
    ) -> Arrival:
        """Return geometry of places (m, 3) [m], frequencies (m,) or () [Hz]; probability (m, K)
        if known.
        """
        dtype = self.power.dtype
        probability = (
            self.visibility.probability_seen(places) if probability is None else probability
        )
        retained = torch.zeros(0, len(places), len(self.rows), dtype=dtype)
        if len(self.incoherent):
            several = self.positions.select(self.incoherent)
            retained = coherence(
                several.phase_vectors(places, frequency, dtype), self.phase_vectors
            )
        correlation = self.kernel.correlation(places, self.rows.position, dtype)
        return Arrival(
            ranges(places, self.positions.points), probability.to(dtype), correlation, retained
        )

    def arrival_at_rows(self, probability: Tensor) -> Arrival:
        """Return the rows' own geometry, with the probability (receivers, K)
        that each sees each source.
        """
        return self.arrival_at(self.rows.position, self.rows.frequency, probability[self.observer])

    def mean_gains(self, at: Arrival) -> Tensor:
        """Return the posterior mean gains (m, K, R) where they are seen."""
        weights = self.dual_weights
        gain = (at.correlation @ weights.flatten(1)).unflatten(1, weights.shape[1:])
        if len(self.incoherent):
            retained = at.retained * at.correlation
            gain[:, self.incoherent] = torch.einsum(
                "kmn,nkrc->mkrc", retained, weights[:, self.incoherent]
            )
        return torch.view_as_complex(gain)

    def error_and_power(self, at: Arrival, carrier_hz: float) -> tuple[Tensor, Tensor]:
        """Return the expected squared error and expected power (m,); of gains,
        noise and visibility.
        """
        probability, noise = at.probability, self.kernel.noise
        arriving = point_wave(at.away, carrier_hz, self.power.dtype)
        powers = arriving.abs().square() * self.power
        cross = (
            self._cross_covariance(arriving * probability, at.retained, self.power) * at.correlation
        )
        gains = (powers * probability.square()).sum(1) - self.conditioned.explained_variance(cross)
        # Variance p (1 - p) of a source that is seen or not, times its power.
        of_visibility = (powers * probability * (1 - probability)).sum(1)
        return gains.clamp_min(0) + of_visibility + noise, (powers * probability).sum(1) + noise

    def predict_left_out(self) -> Tensor:
        """Return the rows (n, R), each receiver and its own visibility left out."""
        at = self.arrival_at_rows(self.visibility.left_out)
        waves = self.unobstructed_waves * at.probability
        cross = self._cross_covariance(waves, at.retained, self.power) * at.correlation
        predicted, inverse = self.conditioned.mean(cross), self.conditioned.factor.inverse
        groups = rows_of_groups(self.observer.numpy())
        residual, _ = self.conditioned.left_out(groups)
        for group in groups:
            # Weights without rows S are `K^-1 y - (K^-1)_:S (K^-1_SS)^-1 (K^-1 y)_S`:
            # no other factor.
            predicted[group] -= cross[group] @ (inverse[:, group] @ residual[group])
        return predicted

    def _gain_correlation(self, kernel: GainKernel) -> Tensor:
        return kernel.correlation(self.rows.position, self.rows.position)

    def _coherence(self) -> Tensor:
        return coherence(self.phase_vectors, self.phase_vectors)

    def _cross_covariance(self, waves: Tensor, retained: Iterable[Tensor], power: Tensor) -> Tensor:
        """Covariance (m, n) of waves (m, K) with the rows, before the correlation over places."""
        uncertain = self.incoherent
        # Certain sources together in one product; each uncertain one has a coherence of its own.
        exact = power.index_fill(0, uncertain, 0.0) if len(uncertain) else power
        total = (waves * exact) @ self.waves.mH
        if not len(uncertain):
            return total
        # In real numbers, with one buffer: products of complex columns would each take three of all
        # rows.
        real, imag = total.real.contiguous(), total.imag.contiguous()
        buffer = torch.empty_like(real)
        for k, coherent in zip(uncertain.tolist(), retained, strict=True):
            query, other = (
                torch.view_as_real(components[:, k].contiguous())
                for components in (power * waves, self.waves)
            )
            real.addcmul_(torch.mm(query, other.T, out=buffer), coherent)
            turned = torch.stack([query[:, 1], -query[:, 0]], 1)
            imag.addcmul_(torch.mm(turned, other.T, out=buffer), coherent)
        return torch.complex(real, imag)

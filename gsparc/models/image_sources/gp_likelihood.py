"""The image-source Gaussian process: likelihood of measured rows given a scene of sources.

    h(x, f) = sum_k g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,   g_k ~ GP(0, s_k^2 visibility_k(x, x'))

so two rows have covariance `sum_k s_k^2 a_k a_k'* C_k + noise`, with regression as in C. E. Rasmussen
and C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), chapters 2 and 5.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.blocking import Clutter, visible_share
from gsparc.models.image_sources.clutter.unfold import Unfolding
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.physics.mirror_planes import Reflections, images
from gsparc.physics.waves import ranges, wave
from gsparc.processes.conditioned import Conditioned

JITTER = 1e-5  # of unit signal power; what float32 needs to factor the covariance


@final
@dataclass(frozen=True)
class Scene:
    """Image sources as sequences over mirror planes, with amplitudes, visibility, clutter and noise.

    Attributes:
        transmitter: (3,) float64 [m], the sequence ().
        planes: (P, 4) float64, see `gsparc.physics.mirror_planes`.
        sequences: K of them, the transmitter first.
        log_amplitude: (K,) float32, log s_k.
        log_noise: log of the noise variance, in units of the rows' power.
        visibility: kernel of all sources' gains, beside the occlusion by clutter.
        clutter: occluding boxes and finite mirrors.
    """

    transmitter: Tensor
    planes: Tensor
    sequences: tuple[Reflections, ...]
    log_amplitude: Tensor
    log_noise: float
    visibility: KernelVisibility = KernelVisibility()  # noqa: RUF009 frozen
    clutter: Clutter = field(default_factory=Clutter.none)

    @cached_property
    def sources(self) -> Tensor:
        """Positions (K, 3) float64 [m]."""
        return images(self.transmitter, self.planes, self.sequences)

    @cached_property
    def unfolding(self) -> Unfolding:
        """The legs of every sequence's path."""
        return Unfolding.of(self.transmitter, self.planes, self.sequences)

    def visible_share(self, places: Tensor) -> Tensor:
        """Share of each source that clutter lets through to places (n, 3) [m]: (n, K), or (1, 1)."""
        if not len(self.clutter):
            return torch.ones(1, 1)
        return visible_share(self.unfolding.paths(places), self.clutter, self.planes).T

    def images(self, rows: Rows) -> Tensor:
        """Images (K, 3) float64 [m] of the static end, or (E, K, 3) of each of its antennas."""
        return images(rows.static_ends(self.transmitter), self.planes, self.sequences)

    def unobstructed(self, rows: Rows) -> Tensor:
        """Waves (n, K) complex64 of the sources at every row, without clutter."""
        return steering(rows, self.images(rows))

    def waves(self, rows: Rows) -> Tensor:
        """The same, attenuated by clutter."""
        return self.unobstructed(rows) * self.visible_share(rows.position)

    def with_sequences(self, sequences: list[Reflections], amplitude: Tensor) -> Scene:
        """More sources, with amplitudes (k,)."""
        log_amplitude = torch.cat([self.log_amplitude, amplitude.log().float()])
        return replace(self, sequences=(*self.sequences, *sequences), log_amplitude=log_amplitude)

    def only(self, kept: list[int], planes: Iterable[int] = ()) -> Scene:
        """The sources of these indices, and the planes that they use, or that are named."""
        sequences = [self.sequences[i] for i in kept]
        used = sorted({index for sequence in sequences for index in sequence}.union(planes))
        new = {old: i for i, old in enumerate(used)}
        renamed = tuple(tuple(new[index] for index in sequence) for sequence in sequences)
        return replace(
            self,
            planes=self.planes[used],
            sequences=renamed,
            log_amplitude=self.log_amplitude[kept],
            clutter=self.clutter.renamed(new),
        )


def steering(rows: Rows, sources: Tensor) -> Tensor:
    """Spherical waves (n, K) complex64 of sources at every row.

    Args:
        rows: n of them.
        sources: (K, 3) float64 [m], or (E, K, 3) when the rows are of E antennas of the static end.

    Raises:
        ValueError: the images of the antennas are missing.
    """
    if rows.element is not None:
        if sources.dim() != 3:
            raise ValueError("rows of several static antennas need the images of each, (E, K, 3)")
        sources = sources.index_select(0, rows.element)  # (n, K, 3)
    return wave(ranges(rows.position, sources), rows.frequency[:, None])


def direct_amplitude(rows: Rows, transmitter: Tensor) -> Tensor:
    """Amplitude () of the direct wave of the static end (3,) [m] if it were all there is."""
    waves = steering(rows, rows.static_ends(transmitter)[..., None, :])
    return (waves.mH @ rows.target).abs().mean() / waves.abs().square().sum()


def correlations(rows: Rows, sources: Tensor, kernel: KernelVisibility) -> Tensor:
    """Visibility correlations (K, n, n) float32."""
    return torch.stack([kernel.correlation(rows.places, source) for source in sources])


class CircularGains:
    """Covariance of n rows by sources whose gains have any phase, to which sources are added one by one."""

    def __init__(self, rows: Rows) -> None:
        self.target, n = rows.target, len(rows)
        self._real, self._imag = torch.zeros(n, n), torch.zeros(n, n)

    @property
    def matrix(self) -> Tensor:
        """(n, n) complex64."""
        return torch.complex(self._real, self._imag)

    def add(self, scaled: Tensor, correlation: Tensor) -> None:
        """Add one source, `(s a)(s a)^H * C`."""
        pair = torch.stack([scaled.real, scaled.imag], 1)
        turned = torch.stack([scaled.imag, -scaled.real], 1)
        self._real.addcmul_(correlation, pair @ pair.T)
        self._imag.addcmul_(correlation, turned @ pair.T)

    def given(self, noise: Tensor | float) -> Conditioned:
        """The rows' targets given the covariance with noise of this variance."""
        self._real.diagonal().add_(noise)
        return Conditioned.of(self.matrix, self.target)

    def by_waves(self, slope: Tensor, scaled: Tensor, correlation: Tensor) -> Tensor:
        """Derivatives (n, K) of the negative log likelihood by waves (n, K), `2 (G * C_k) s_k a_k`."""
        real, imag = slope.real.contiguous(), slope.imag.contiguous()
        found = torch.empty_like(scaled)
        for k, one in enumerate(correlation):
            pair = torch.stack([scaled[:, k].real, scaled[:, k].imag], 1)
            a, b = (real * one) @ pair, (imag * one) @ pair
            found[:, k] = torch.complex(a[:, 0] - b[:, 1], a[:, 1] + b[:, 0])
        return 2 * found

    def by_noise(self, slope: Tensor) -> Tensor:
        """The derivative () by the variance of the noise."""
        return slope.diagonal().real.sum()

    def by_correlation(self, slope: Tensor, scaled: Tensor) -> Tensor:
        """Derivatives (n, n) by the correlation of one source."""
        return (slope.conj() * scaled[:, None] * scaled.conj()).real


def with_noise(covariance: Tensor, noise: float, target: Tensor) -> Conditioned:
    """Targets (n, R) given a covariance to whose diagonal noise and jitter are added in place."""
    level = max(1.0, float(covariance.diagonal().real.mean()))
    covariance.diagonal().add_(noise + JITTER * level)
    return Conditioned.of(covariance, target)


class Posterior:
    """Posterior of a scene's gains given rows."""

    def __init__(self, rows: Rows, scene: Scene, noise_floor: float = JITTER) -> None:
        self.rows, self.scene, self.noise_floor = rows, scene, noise_floor

    @cached_property
    def waves(self) -> Tensor:
        """(n, K) complex64."""
        return self.scene.waves(self.rows)

    def gains(self) -> CircularGains:
        """Of no source yet."""
        return CircularGains(self.rows)

    @cached_property
    def _summed(self) -> CircularGains:
        found, scaled = self.gains(), self.waves * self.scene.log_amplitude.exp()
        for k, source in enumerate(self.scene.sources):
            found.add(scaled[:, k], self.scene.visibility.correlation(self.rows.places, source))
        return found

    @cached_property
    def conditioned(self) -> Conditioned:
        """The rows' targets given their covariance."""
        return self._summed.given(torch.tensor(self.scene.log_noise).exp() + self.noise_floor)

    @property
    def covariance(self) -> Tensor:
        """Of the rows, noise included."""
        assert self.conditioned
        return self._summed.matrix

    @property
    def nll(self) -> float:
        """Negative log marginal likelihood up to a constant."""
        return self.conditioned.nll

    def without(self, k: int) -> float:
        """`nll` of the scene without source k."""
        one, source = CircularGains(self.rows), self.scene.sources[k]
        correlation = self.scene.visibility.correlation(self.rows.places, source)
        one.add(self.waves[:, k] * self.scene.log_amplitude[k].exp(), correlation)
        return Conditioned.of(self.covariance - one.matrix, self.rows.target).nll

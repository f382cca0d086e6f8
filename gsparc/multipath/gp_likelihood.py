"""The virtual-source Gaussian process: a scene of sources confronted with measured rows.

    h(x, f) = sum_k g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,   g_k ~ GP(0, s_k^2 visibility_k(x, x'))

so two rows have covariance `sum_k s_k^2 a_k a_k'* C_k + noise`; the rest is regression as in C. E. Rasmussen
and C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), chapters 2 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from gsparc.multipath.clutter.blocking import Clutter, shade
from gsparc.multipath.clutter.unfold import Unfolding
from gsparc.multipath.rows import Rows
from gsparc.multipath.visibility_kernel import KernelVisibility, View, Visibility
from gsparc.physics.mirror_planes import Word, images
from gsparc.physics.waves import ranges, wave

JITTER = 1e-5  # of unit signal power; what float32 needs to factor the covariance


@dataclass(frozen=True)
class Scene:
    """Sources as words over mirror planes, how strong each is, who sees it, and the noise.

    Attributes:
        transmitter: (3,) float64 [m], the word ().
        planes: (P, 4) float64, see `gsparc.physics.mirror_planes`.
        words: K of them, the transmitter first.
        log_amplitude: (K,) float32, log s_k.
        log_noise: log of the noise variance, in units of the rows' power.
        visibility: one law for all, of what the clutter leaves open.
        clutter: what blocks paths and where mirrors end.
    """

    transmitter: Tensor
    planes: Tensor
    words: tuple[Word, ...]
    log_amplitude: Tensor
    log_noise: float
    visibility: Visibility = KernelVisibility()  # noqa: RUF009 frozen
    clutter: Clutter = field(default_factory=Clutter.none)

    @cached_property
    def sources(self) -> Tensor:
        """Positions (K, 3) float64 [m]."""
        return images(self.transmitter, self.planes, self.words)

    @cached_property
    def unfolding(self) -> Unfolding:
        """The legs of every word's path."""
        return Unfolding.of(self.transmitter, self.planes, self.words)

    def shade(self, places: Tensor) -> Tensor:
        """How much of each source the clutter lets through to places (n, 3) [m]: (n, K), or (1, 1)."""
        if not len(self.clutter):
            return torch.ones(1, 1)
        return shade(self.unfolding.paths(places), self.clutter, self.planes).T

    def waves(self, rows: Rows) -> Tensor:
        """Waves (n, K) complex64 of the sources at every row, as far as they are seen."""
        return steering(rows, self.sources) * self.shade(rows.position)

    def with_words(self, words: list[Word], amplitude: Tensor) -> Scene:
        """More sources, with amplitudes (k,)."""
        log_amplitude = torch.cat([self.log_amplitude, amplitude.log().float()])
        return replace(self, words=(*self.words, *words), log_amplitude=log_amplitude)

    def only(self, kept: list[int]) -> Scene:
        """The sources with these numbers, and the planes that they still need."""
        words = [self.words[i] for i in kept]
        used = sorted({letter for word in words for letter in word})
        new = {old: i for i, old in enumerate(used)}
        renamed = tuple(tuple(new[letter] for letter in word) for word in words)
        return replace(
            self,
            planes=self.planes[used],
            words=renamed,
            log_amplitude=self.log_amplitude[kept],
            clutter=self.clutter.renamed(new),
        )


def steering(rows: Rows, sources: Tensor) -> Tensor:
    """Spherical waves (n, K) complex64 of sources (K, 3) float64 [m] at every row."""
    return wave(ranges(rows.position, sources), rows.frequency[:, None])


def correlations(rows: Rows, sources: Tensor, law: Visibility) -> Tensor:
    """Visibility correlations (K, n, n) float32."""
    return torch.stack([_correlation(rows, source, law) for source in sources])


def _correlation(rows: Rows, source: Tensor, law: Visibility) -> Tensor:
    view = View.of(rows.position, source)
    return law.correlation(view, view)


def add_covariance(real: Tensor, imag: Tensor, scaled: Tensor, correlation: Tensor) -> None:
    """Add one source, `(s a)(s a)^H * C`, to a covariance (n, n) held as two real matrices."""
    pair = torch.stack([scaled.real, scaled.imag], 1)
    turned = torch.stack([scaled.imag, -scaled.real], 1)
    real.addcmul_(correlation, pair @ pair.T)
    imag.addcmul_(correlation, turned @ pair.T)


@dataclass(frozen=True)
class Factor:
    """A factored covariance of n rows with R outputs.

    Attributes:
        lower: (n, n) complex64, Cholesky factor.
        alpha: (n, R) complex64, K^-1 y.
        nll: negative log marginal likelihood up to a constant.
    """

    lower: Tensor
    alpha: Tensor
    nll: float

    @staticmethod
    def of(covariance: Tensor, target: Tensor) -> Factor:
        """From a positive definite covariance, noise included."""
        lower = torch.linalg.cholesky(covariance)
        alpha = torch.cholesky_solve(target, lower)
        determinant = 2 * lower.diagonal().real.double().log().sum()
        fit = (target.conj() * alpha).real.double().sum()
        return Factor(lower, alpha, float(fit + target.shape[1] * determinant))

    @cached_property
    def root(self) -> Tensor:
        """(n, n), inverse of `lower`: K^-1 = root^H root."""
        eye = torch.eye(len(self.lower), dtype=self.lower.dtype)
        return torch.linalg.solve_triangular(self.lower, eye, upper=False)

    @cached_property
    def inverse(self) -> Tensor:
        """K^-1 (n, n)."""
        return torch.cholesky_inverse(self.lower)


class Posterior:
    """A scene confronted with rows."""

    def __init__(self, rows: Rows, scene: Scene, noise_floor: float = JITTER) -> None:
        self.rows, self.scene, self.noise_floor = rows, scene, noise_floor

    @cached_property
    def waves(self) -> Tensor:
        """(n, K) complex64."""
        return self.scene.waves(self.rows)

    @cached_property
    def covariance(self) -> Tensor:
        """(n, n) complex64, noise included."""
        n = len(self.rows)
        real, imag = torch.zeros(n, n), torch.zeros(n, n)
        scaled = self.waves * self.scene.log_amplitude.exp()
        for k, source in enumerate(self.scene.sources):
            add_covariance(real, imag, scaled[:, k], self.correlation(source))
        real.diagonal().add_(torch.tensor(self.scene.log_noise).exp() + self.noise_floor)
        return torch.complex(real, imag)

    def correlation(self, source: Tensor) -> Tensor:
        """Visibility correlation (n, n) of one source (3,)."""
        return _correlation(self.rows, source, self.scene.visibility)

    @cached_property
    def factor(self) -> Factor:
        """Of the covariance and the rows' targets."""
        return Factor.of(self.covariance, self.rows.target)

    @property
    def nll(self) -> float:
        """Negative log marginal likelihood up to a constant."""
        return self.factor.nll

    def without(self, k: int) -> float:
        """The likelihood of the scene less source k."""
        scaled = self.waves[:, k] * self.scene.log_amplitude[k].exp()
        n = len(self.rows)
        real, imag = torch.zeros(n, n), torch.zeros(n, n)
        add_covariance(real, imag, scaled, self.correlation(self.scene.sources[k]))
        return Factor.of(self.covariance - torch.complex(real, imag), self.rows.target).nll

    def gains(self, places: Tensor) -> Tensor:
        """Posterior mean gains (m, K, R) complex64 at places (m, 3) float64 [m], as far as seen."""
        weights = self.waves.conj() * self.scene.log_amplitude.mul(2).exp()
        per_source = []
        for k, source in enumerate(self.scene.sources):
            here, there = View.of(places, source), View.of(self.rows.position, source)
            correlation = self.scene.visibility.correlation(here, there)
            pulled = weights[:, k, None] * self.factor.alpha
            per_source.append(torch.complex(correlation @ pulled.real, correlation @ pulled.imag))
        return torch.stack(per_source, 1) * self.scene.shade(places)[:, :, None]

    def variance(self, queries: Rows) -> Tensor:
        """Expected squared error (m,) float32 of each query row, noise included."""
        waves = self.scene.waves(queries)
        power = self.scene.log_amplitude.mul(2).exp()
        cross = torch.zeros(len(queries), len(self.rows), dtype=torch.complex64)
        for k, source in enumerate(self.scene.sources):
            here, there = View.of(queries.position, source), View.of(self.rows.position, source)
            correlation = self.scene.visibility.correlation(here, there) * power[k]
            cross += waves[:, k, None] * self.waves[:, k].conj() * correlation
        prior = (power * waves.abs().square()).sum(1) + torch.tensor(self.scene.log_noise).exp()
        return (prior - (self.factor.root @ cross.mH).abs().square().sum(0)).clamp_min(0)

    def left_out(self) -> Tensor:
        """Each row predicted from the rows of all other receivers (n, R) complex64 (eq. 5.12, in blocks)."""
        error = self.factor.alpha / self.factor.inverse.diagonal().real[:, None]
        order = torch.argsort(self.rows.receiver, stable=True)
        groups = order.split(
            torch.unique_consecutive(self.rows.receiver[order], return_counts=True)[1].tolist()
        )
        for group in groups:
            if len(group) > 1:
                block = self.factor.inverse[group[:, None], group]
                error[group] = torch.linalg.solve(block, self.factor.alpha[group])
        return self.rows.target - error

"""The image-source Gaussian process: likelihood of measured rows given a scene,
and posterior of its gains.

    h(x, f) = sum_k g_k(x) exp(-j 2 pi f r_k / c) / r_k + noise,
    g_k ~ GP(0, s_k^2 visibility_k(x, x'))

so two rows have covariance `sum_k s_k^2 a_k a_k'* C_k + noise`, with regression as in C. E.
Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), chapters 2 and 5.

Once the sources are known, gains have phases: the phase of a reflection is the same at all places;
what varies is the visible share of a source. So `g_k(x) = exp(j phi_k) (u_k(x) + j v_k(x))` with
real Gaussian processes u_k and v_k, and nearly all the variance in u_k: a share `quadrature / 2` is
in v_k (1 / 2 would be the circular process above). In real and imaginary parts, n complex rows are
2 n real numbers of covariance
    sum_k s_k^2 C_k * [(1 - quadrature / 2) p p^T + quadrature / 2 q q^T] + noise / 2

with p = (Re w_k, Im w_k), q = (-Im w_k, Re w_k), w_k = a_k exp(j phi_k). It halves what must be
learned of each source's visibility; the phases must be known first,
so the search itself stays circular.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import JITTER, SourceScene
from gsparc.models.predicting import to_double
from gsparc.processes.conditioned import Conditioned


def condition_with_noise(covariance: Tensor, noise: float, target: Tensor) -> Conditioned:
    """Return targets (n, R) given a covariance to whose diagonal noise
    and jitter are added in place.
    """
    # Rounding grows with the diagonal, which sources near the places raise far above 1.
    level = max(1.0, float(covariance.diagonal().real.mean()))
    covariance.diagonal().add_(noise + JITTER * level)
    return Conditioned.from_gram(covariance, target)


class CircularGains:
    """Covariance of n rows by sources whose gains have any phase,
    to which sources are added one by one.
    """

    def __init__(self, rows: Rows) -> None:
        self.target, n = rows.target, len(rows)
        self._real, self._imag = rows.target.real.new_zeros(2, n, n)

    @property
    def matrix(self) -> Tensor:
        """(n, n) complex64."""
        return torch.complex(self._real, self._imag)

    def add_source(self, scaled: Tensor, correlation: Tensor) -> None:
        """Add one source, `(s a)(s a)^H * C`."""
        # With a = p + j q: a a^H = (p p^T + q q^T) + j (q p^T - p q^T).
        pair = torch.stack([scaled.real, scaled.imag], 1)
        turned = torch.stack([scaled.imag, -scaled.real], 1)
        self._real.addcmul_(correlation, pair @ pair.T)
        self._imag.addcmul_(correlation, turned @ pair.T)

    def add_noise_and_condition(self, noise: Tensor | float) -> Conditioned:
        """Add noise of this variance to `matrix`, for good,
        and return the rows' targets given it.
        """
        self._real.diagonal().add_(noise)
        return Conditioned.from_gram(self.matrix, self.target)

    def grad_waves(self, slope: Tensor, scaled: Tensor, correlation: Tensor) -> Tensor:
        """Return slopes (n, K) of the negative log likelihood by waves (n, K),
        `2 (G * C_k) s_k a_k`.
        """
        real, imag = slope.real.contiguous(), slope.imag.contiguous()
        slopes = torch.empty_like(scaled)
        for k, block in enumerate(correlation):
            pair = torch.stack([scaled[:, k].real, scaled[:, k].imag], 1)
            a, b = (real * block) @ pair, (imag * block) @ pair
            slopes[:, k] = torch.complex(a[:, 0] - b[:, 1], a[:, 1] + b[:, 0])
        return 2 * slopes

    def grad_noise(self, slope: Tensor) -> Tensor:
        """Return the derivative () by the variance of the noise."""
        return slope.diagonal().real.sum()

    def grad_correlation(self, slope: Tensor, scaled: Tensor) -> Tensor:
        """Return derivatives (n, n) by the correlation of one source."""
        return (slope.conj() * scaled[:, None] * scaled.conj()).real


def stack_real_imag(waves: Tensor) -> tuple[Tensor, Tensor]:
    """Return p and q, each (2 n, ...) float32, of complex (n, ...)."""
    return torch.cat([waves.real, waves.imag]), torch.cat([-waves.imag, waves.real])


def quadrature_variances(quadrature: Tensor | float) -> Tensor:
    """Return the variance along and across a gain's phase, (2,)."""
    return torch.tensor([1 - quadrature / 2, quadrature / 2])


class PhasedGains(CircularGains):
    """The same of gains of fixed phases, of 2 n real numbers; waves are turned by these."""

    def __init__(self, rows: Rows, quadrature: Tensor | float) -> None:
        self.target, n = rows.target, len(rows)
        self.quadrature, self._sum = quadrature, rows.target.real.new_zeros(2, n, 2, n)

    @property
    def matrix(self) -> Tensor:
        """(2 n, 2 n) float32."""
        return self._sum.view(2 * len(self.target), -1)

    def add_source(self, scaled: Tensor, correlation: Tensor) -> None:
        """Add one source, with waves s_k w_k."""
        pair = torch.stack(stack_real_imag(scaled), 1)
        product = (pair * quadrature_variances(self.quadrature)) @ pair.T
        self._sum.addcmul_(product.view_as(self._sum), correlation[None, :, None, :])

    def add_noise_and_condition(self, noise: Tensor | float) -> Conditioned:
        """Add half of the noise to either part of `matrix`, for good; return the (2 n,)
        targets given it.
        """
        self.matrix.diagonal().add_(noise / 2)
        return Conditioned.from_gram(self.matrix, stack_real_imag(self.target)[0])

    def grad_waves(self, slope: Tensor, scaled: Tensor, correlation: Tensor) -> Tensor:
        """See `CircularGains`."""
        n, slopes = len(scaled), torch.empty_like(scaled)
        blocks = slope.view(2, n, 2, n)
        for k, block in enumerate(correlation):
            pair = torch.stack(stack_real_imag(scaled[:, k]), 1) * quadrature_variances(
                self.quadrature
            )
            by = (blocks * block[None, :, None, :]).view(2 * n, 2 * n) @ pair
            # p = (Re, Im) and q = (-Im, Re): the derivatives by Re and Im collect both
            slopes[:, k] = torch.complex(by[:n, 0] + by[n:, 1], by[n:, 0] - by[:n, 1])
        return slopes

    def grad_noise(self, slope: Tensor) -> Tensor:
        """See `CircularGains`."""
        # Half of the noise is in either part, and of real values d nll is half of trace(G dK).
        return slope.diagonal().sum() / 4

    def grad_correlation(self, slope: Tensor, scaled: Tensor) -> Tensor:
        """See `CircularGains`; differentiable in `quadrature`."""
        n, share = len(scaled), torch.as_tensor(self.quadrature) / 2
        along, across = (
            (slope * z[:, None] * z).view(2, n, 2, n).sum((0, 2)) for z in stack_real_imag(scaled)
        )
        # Half, as d nll of real values is half of trace(G dK) (`Conditioned.nll_gradient`).
        return ((1 - share) * along + share * across) / 2


class GainPosterior:
    """Posterior of a scene's gains given rows,
    circular or of fixed phases (`SourceScene.phase`).
    """

    def __init__(self, rows: Rows, scene: SourceScene) -> None:
        self.rows, self.scene = rows, scene

    @cached_property
    def in_float64(self) -> GainPosterior:
        """The same in float64: rows 30 dB above their noise lose three digits
        where they are factored.
        """
        _ = self.scene.unfolding, self.scene.obstacles  # which are doubled with the scene
        return to_double(GainPosterior(self.rows, self.scene))

    @cached_property
    def waves(self) -> Tensor:
        """(n, K) complex, turned by the phases."""
        return self.scene.waves(self.rows)

    def empty_covariance(self) -> CircularGains:
        """Return the covariance of no source yet."""
        if self.scene.phase is None:
            return CircularGains(self.rows)
        return PhasedGains(self.rows, self.scene.quadrature)

    @cached_property
    def source_gram(self) -> CircularGains:
        """Covariance of all sources, without noise until `conditioned` adds it."""
        gains, scaled = self.empty_covariance(), self.waves * self.scene.log_amplitude.exp()
        for k, source in enumerate(self.scene.sources):
            shared = self.scene.visibility.correlation(self.rows.places, source, scaled.real.dtype)
            gains.add_source(scaled[:, k], shared)
        return gains

    @cached_property
    def conditioned(self) -> Conditioned:
        """The rows' targets given their covariance."""
        noise = (
            self.scene.log_amplitude.new_tensor(self.scene.log_noise).exp() + self.scene.noise_floor
        )
        return self.source_gram.add_noise_and_condition(noise)

    @property
    def covariance(self) -> Tensor:
        """Covariance of the rows, noise included."""
        # The noise is added to the sums when they are first conditioned.
        _ = self.conditioned
        return self.source_gram.matrix

    @property
    def nll(self) -> float:
        """Negative log marginal likelihood up to a constant."""
        return self.conditioned.nll

    def nll_without_source(self, k: int) -> float:
        """Return `nll` of the scene without source k, of circular gains."""
        gains, source = CircularGains(self.rows), self.scene.sources[k]
        correlation = self.scene.visibility.correlation(self.rows.places, source)
        gains.add_source(self.waves[:, k] * self.scene.log_amplitude[k].exp(), correlation)
        return Conditioned.from_gram(self.covariance - gains.matrix, self.rows.target).nll

    # ---- of gains of fixed phases ----
    @property
    def dual_weights(self) -> Tensor:
        """Dual weights of u_k + j v_k (K, n, R), before the correlation over places."""
        n, (along, across) = len(self.rows), quadrature_variances(self.scene.quadrature)
        alpha = torch.complex(*self.conditioned.weights.split(n))
        power = self.scene.log_amplitude.mul(2).exp()
        circular = (self.waves.conj() * power).T[:, :, None] * alpha
        return torch.complex(along * circular.real, across * circular.imag)

    @property
    def mean_gains(self) -> Tensor:
        """Constant part of each source's gain (K, R) complex64."""
        constant = float(self.scene.visibility.constant)
        return constant * self.dual_weights.sum(1) * self.scene.phase_factors[:, None]

    def predict_left_out(self) -> Tensor:
        """Return leave-one-receiver-out predictions (n, R) complex64.

        Rasmussen and Williams (2006), eq. 5.12, in blocks.
        """
        n = len(self.rows)
        order = torch.argsort(self.rows.receiver, stable=True)
        counts = torch.unique_consecutive(self.rows.receiver[order], return_counts=True)[1]
        # Both parts of a receiver's rows: either one alone would tell the other.
        groups = (torch.cat([group, group + n]) for group in order.split(counts.tolist()))
        error, _ = self.conditioned.left_out(groups)
        return self.rows.target - torch.complex(error[:n], error[n:])


def estimate_phases(
    rows: Rows, scene: SourceScene, quadrature: float, noise_floor: float
) -> SourceScene:
    """Return the scene with phases of mean gains under the circular process, and a noise floor."""
    posterior = GainPosterior(rows, replace(scene, noise_floor=JITTER))
    # The mean gain but for its power and constant share, which are positive and do not turn it.
    gain = (posterior.waves.mH @ posterior.conditioned.weights).sum(1)
    single = rows.target.shape[1] == 1
    return replace(
        scene, phase=gain.angle(), quadrature=quadrature if single else 1.0, noise_floor=noise_floor
    )

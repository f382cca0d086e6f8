"""Residual of a scene, and the gain of another box, patch or source.

The process of gains of fixed phases with its covariance in two parts: varying gains and noise,
factored once and held, and the sources' constant gains, a low-rank part that changes with every
move of a box and is added by the matrix inversion lemma (Rasmussen and Williams, 2006, eq. A.9).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.unfold import Legs
from gsparc.models.image_sources.gp_likelihood import (
    GainPosterior,
    quadrature_variances,
    stack_real_imag,
)
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import SourceScene
from gsparc.processes.factor import Factor
from gsparc.processes.worker import raise_if_cancelled

TRIED = 1.5  # factor between two candidates of the noise variance
LEAST_NOISE = 3e-4  # variance, in units of the rows' power; smaller estimates mean a failed search
BLOCK = 64  # candidates at a time
LEAST_VARYING = 0.01  # share of a gain's variance, by the same factor up to two fifths
CONSTANTS = tuple(1 - LEAST_VARYING * TRIED**number for number in range(9, -1, -1))  # candidates
NEGLIGIBLE = 1e-2  # squared size of a whitened change that the constant parts take up almost wholly


class ClutterLikelihood:
    """Rows of one output against a scene with phases; n rows are 2 n real numbers.

    Args:
        rows: R = 1.
        scene: its clutter attenuates the varying part; callers pass the visible shares of the
            constant part.

    Attributes:
        scene: as given, constant share and noise chosen by likelihood.
    """

    def __init__(self, rows: Rows, scene: SourceScene) -> None:
        self.rows, self.noise_floor = rows, scene.noise_floor
        self.target = stack_real_imag(rows.target)[0][:, 0]
        self.waves = scene.unobstructed_waves(rows)
        self._cached = self._gain_covariances(scene)
        self.scene = self._tune_share_and_noise(scene)
        constant = float(self.scene.visibility.constant)
        self._factor_covariance(constant, self.scene.log_noise, scene.quadrature)
        self.share = self._constant_scale(constant, scene.quadrature)
        self.root = self._own.root
        self.white = self.root @ self.target
        # Two matrices (2 n, 2 n) go; the root is all that is asked from here on.
        del self._cached, self._own

    def _gain_covariances(self, scene: SourceScene) -> tuple[Tensor, Tensor]:
        """Covariances (2 n, 2 n) of gains that vary freely,
        and of constant gains across their phase.
        """
        scaled = scene.waves(self.rows) * scene.log_amplitude.exp()
        varying = GainPosterior(
            self.rows, replace(scene, visibility=replace(scene.visibility, constant=0.0))
        )
        across = stack_real_imag(scaled)[1]
        return varying.source_gram.matrix, quadrature_variances(scene.quadrature)[1] * (
            across @ across.T
        )

    def _tune_share_and_noise(self, scene: SourceScene) -> SourceScene:
        """Constant share and noise by likelihood, in turn on a grid."""
        columns = stack_real_imag(scene.waves(self.rows) * scene.log_amplitude.exp())[0]
        kernel, noise = scene.visibility, scene.log_noise
        # The nearest on the grid, from which steps go either way.
        constant = min(CONSTANTS, key=lambda c: abs(c - float(kernel.constant)))

        def nll(constant: float, noise: float) -> float:
            self._factor_covariance(constant, noise, scene.quadrature)
            whitened = self._own.whiten(columns * self._constant_scale(constant, scene.quadrature))
            white = self._own.whiten(self.target[:, None])[:, 0]
            return _nll(whitened, white, self._determinant).item()

        best = nll(constant, noise)
        # Twice: the likeliest noise moves with the constant share, and the share with it.
        for _ in range(2):
            place = CONSTANTS.index(constant)
            for direction in (-1, 1):
                at = place + direction
                while 0 <= at < len(CONSTANTS) and (new := nll(CONSTANTS[at], noise)) < best:
                    best, constant, at = new, CONSTANTS[at], at + direction
            for step in (-math.log(TRIED), math.log(TRIED)):
                while (
                    noise + step > math.log(LEAST_NOISE)
                    and (new := nll(constant, noise + step)) < best
                ):
                    best, noise = new, noise + step
        return replace(scene, visibility=replace(kernel, constant=constant), log_noise=noise)

    def _factor_covariance(self, constant: float, noise: float, quadrature: float) -> None:
        varying, across = self._cached
        covariance = (1 - constant) * varying + constant * across
        # Half of the variance in the real parts, half in the imaginary ones.
        covariance.diagonal().add_((math.exp(noise) + self.noise_floor) / 2)
        self._own = Factor.from_gram(covariance)
        self._determinant = 0.5 * float(self._own.log_determinant)

    @staticmethod
    def _constant_scale(constant: float, quadrature: float) -> float:
        return math.sqrt(constant * (1 - quadrature / 2))

    # ---- the constant part ----
    def columns(
        self, visible_share: Tensor, log_amplitude: Tensor, waves: Tensor | None = None
    ) -> Tensor:
        """Return constant gains' standard deviations, whitened (2 n, K), for shades (K, n)."""
        scaled = (self.waves if waves is None else waves) * (
            visible_share.T * log_amplitude.exp() * self.share
        )
        return self.root @ torch.cat([scaled.real, scaled.imag])

    def nll(
        self, visible_share: Tensor, log_amplitude: Tensor, waves: Tensor | None = None
    ) -> Tensor:
        """Return the negative log likelihood (), in nats; differentiable."""
        return _nll(
            self.columns(visible_share, log_amplitude, waves), self.white, self._determinant
        )

    def make_scorer(self, visible_share: Tensor, log_amplitude: Tensor) -> CandidateScorer:
        """Return a scorer of candidates, with the constant parts
        at their posterior means removed.
        """
        columns = self.columns(visible_share, log_amplitude)
        inner, seen = _gram_and_product(columns, self.white)
        chol = Factor.from_gram(inner)
        mean, projection = (
            chol.solve(seen[:, None])[:, 0].float(),
            chol.whiten(columns.T.double()).float(),
        )
        gains = mean * self.share * log_amplitude.exp()
        return CandidateScorer(self.root, projection, self.white - columns @ mean, gains)


class CandidateScorer:
    """Residual after the constant parts, and gains of candidate changes.

    Attributes:
        gains: (K,) float32, posterior mean of each source's constant gain along its phase.
    """

    def __init__(self, root: Tensor, projection: Tensor, residual: Tensor, gains: Tensor) -> None:
        self.root, self.projection, self.residual, self.gains = root, projection, residual, gains

    @property
    def solved_residual(self) -> Tensor:
        """K^-1 y (n,) complex64, constant parts removed."""
        n = len(self.residual) // 2
        both = self.root.T @ self.residual
        return torch.complex(both[:n], both[n:])

    @property
    def precision_diagonal(self) -> Tensor:
        """Diagonal of K^-1 (n,), mean of both parts."""
        return self.root.square().sum(0).view(2, -1).mean(0)

    def gains_of_shares(
        self, candidates: Tensor, share: Callable[[Tensor], Tensor], waves: Tensor
    ) -> Tensor:
        """Return the log likelihood (m,) [nats] that m candidates gain
        by adding waves times their shares.

        Args:
            candidates: (m, ...), taken in blocks of b.
            share: maps b candidates to shares (b, K, n).
            waves: (n, K) complex.
        """
        scores = []
        for part in candidates.split(BLOCK):
            raise_if_cancelled()
            each = share(part)
            change = [torch.einsum("bkn,nk->nb", each, wave) for wave in (waves.real, waves.imag)]
            scores.append(self.gains_and_multiples(torch.complex(*change))[0])
        return torch.cat(scores)

    def gains_and_multiples(self, change: Tensor) -> tuple[Tensor, Tensor]:
        """Return nats (M,) float32 that positive multiples (M,) of complex changes (n, M) gain,
        and these.
        """
        whitened = self.root @ torch.cat([change.real, change.imag])
        power = whitened.square().sum(0) - (self.projection @ whitened).square().sum(0)
        matched = (self.residual @ whitened).clamp_min(0)
        # A negligible change has no size of its own.
        multiple = torch.where(power > NEGLIGIBLE, matched / power.clamp_min(NEGLIGIBLE), 0.0)
        return multiple * matched / 2, multiple

    def gains_and_amplitudes(self, waves: Tensor) -> tuple[Tensor, Tensor]:
        """Return nats (M,) that waves (n, M) of free complex gains would gain,
        and these gains (M,).
        """
        parts = [self.root @ part for part in stack_real_imag(waves)]
        seen = [self.projection @ part for part in parts]
        dot = [
            [(parts[i] * parts[j]).sum(0) - (seen[i] * seen[j]).sum(0) for j in range(2)]
            for i in range(2)
        ]
        along, across = (self.residual @ part for part in parts)
        determinant = (dot[0][0] * dot[1][1] - dot[0][1].square()).clamp_min(NEGLIGIBLE**2)
        gain = torch.complex(
            (dot[1][1] * along - dot[0][1] * across) / determinant,
            (dot[0][0] * across - dot[0][1] * along) / determinant,
        )
        return (along * gain.real + across * gain.imag) / 2, gain


@dataclass(frozen=True)
class UnexplainedRows:
    """What a scene leaves of its rows, and where there may be obstacles that explain it.

    Attributes:
        rows: n of them.
        scene: of K sources.
        scorer: of candidates.
        paths: of the sources.
        waves: (n, K) complex, of the sources as they are seen now.
        room: (2, 3) [m], where obstacles may be.
        generator: of the candidates.
    """

    rows: Rows
    scene: SourceScene
    scorer: CandidateScorer
    paths: Legs
    waves: Tensor
    room: Tensor
    generator: torch.Generator


def _gram_and_product(columns: Tensor, white: Tensor) -> tuple[Tensor, Tensor]:
    """`I + C^T C` (K, K) and `C^T y` (K,), float64, of whitened columns (2 n, K)
    and targets (2 n,).

    Entries of C^T C are rows over noise, 1e7 where there is hardly any:
    float32 would round the I away.
    """
    raise_if_cancelled()
    exact = columns.double()
    return exact.T @ exact + torch.eye(
        columns.shape[1], dtype=torch.float64
    ), exact.T @ white.double()


def _nll(columns: Tensor, white: Tensor, determinant: float) -> Tensor:
    inner, seen = _gram_and_product(columns, white)
    chol = Factor.from_gram(inner)
    explained = white.double().square().sum() - chol.whiten(seen[:, None]).square().sum()
    return determinant + 0.5 * (chol.log_determinant + explained)

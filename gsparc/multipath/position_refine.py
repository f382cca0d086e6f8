"""Where sources are to a fraction of a wavelength: what directions leave open, pinned by channels' phases.

Every source counts as far as it is known (`openness.py`), and one after the other is pinned under the
likelihood in which all others are as open as they still are: many places are drawn from what the rays say,
the best are polished by steps of Gauss and Newton, and where one is clearly the best the source is pinned
there. One with several places about as good stays open until the others tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.multipath.gp_likelihood import JITTER, Factor, steering
from gsparc.multipath.position_uncertainty import Open, coherence, slopes
from gsparc.multipath.rows import Rows
from gsparc.physics.waves import LIGHT

PER_CELL, LEAST_DRAWN, MOST_DRAWN = 6, 32, 768  # places per (quarter wavelength)^3 that is open
POLISHED, STEPS = 6, 8  # the best of them, and steps for each
CLEAR = 0.8  # probability of one place from which on a source is pinned there
SAME = 4.0  # standard deviations within which two places are one
SWEEPS = 8
STILL_M = 1e-3  # a sweep that moves no source by more is the last
NOISE, LEAST_NOISE = 0.1, 1e-3  # of the rows' power
BALANCINGS, RATIO = 3, 8.0  # of powers, and most change in each
LOUD = 4.0  # times the median, at most, is a source's power


@dataclass
class Pinning:
    """Sources on their way from what rays say to what rays and channels say.

    Attributes:
        rows: of unit power.
        seen: (n, K) float32, of each row's receiver.
        prior: what rays say.
        alike: (n, n) float32, correlation of gains.
    """

    rows: Rows
    seen: Tensor
    prior: Open
    alike: Tensor
    seed: int = 0

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)
        self.now, self.noise = self.prior, NOISE
        self.wavelength = LIGHT / float(self.rows.frequency.mean())

    def run(self) -> Open:
        """What rays and channels say of the places."""
        blurred = self.prior.blurred(self.rows.position, self.rows.frequency)
        if not len(blurred):
            return self.now  # directions were exact: no covariance is worth its time
        self.terms = torch.stack([self._term(k) for k in range(len(self.prior.points))])
        loud = float(self.terms.diagonal(dim1=1, dim2=2).real.sum(0).mean())
        self.power = torch.full((len(self.terms),), 1 / max(loud, 1e-30))
        self.pinned = torch.zeros(len(self.terms), dtype=torch.bool)
        size = torch.linalg.det(self.prior.covariance)
        order = blurred[size[blurred].argsort()].tolist()
        for _ in range(SWEEPS):
            self._balance()
            before = self.now.points
            for k in order:
                self._pin(k)
            if float((self.now.points - before).norm(dim=1).max()) < STILL_M:
                break
        return self.now

    def _term(self, k: int) -> Tensor:
        """Covariance (n, n) of the rows by source k of unit power."""
        one = self.now.only(torch.tensor([k]))
        wave = steering(self.rows, one.points)[:, 0] * self.seen[:, k]
        turns = one.turns(self.rows.position, self.rows.frequency)
        return wave[:, None] * wave.conj() * (self.alike * coherence(turns, turns)[0])

    def _total(self, without: int | None = None) -> Tensor:
        """Covariance (n, n) of the rows by all sources but one."""
        power = self.power.to(self.terms.dtype)
        if without is not None:  # a difference of covariances need not be positive definite
            power[without] = 0
        return (power @ self.terms.flatten(1)).unflatten(0, self.terms.shape[1:])

    def _balance(self) -> None:
        """Powers and noise by the fixed point of D. J. C. MacKay ("Bayesian interpolation", 1992)."""
        outputs = self.rows.target.shape[1]
        for _ in range(BALANCINGS):
            factor = _factor(self._total(), self.noise, self.rows)
            said = (factor.alpha.conj() * (self.terms @ factor.alpha)).real.sum((1, 2))
            due = outputs * (factor.inverse.conj() * self.terms).real.sum((1, 2))
            self.power = self.power * (said / due.clamp_min(1e-12)).clamp(1 / RATIO, RATIO)
            self.power = self.power.clamp_max(LOUD * float(self.power.median())).clamp_min(1e-9)
            left = float(factor.alpha.abs().square().sum())
            ratio = left / max(outputs * float(factor.inverse.diagonal().real.sum()), 1e-12)
            self.noise = max(self.noise * min(max(ratio, 1 / RATIO), RATIO), LEAST_NOISE)

    def _pin(self, k: int) -> None:
        """Place and covariance of source k by its rays, and by the channels given all others."""
        given = Given.of(self, k, _factor(self._total(without=k), self.noise, self.rows))
        if self.pinned[k]:
            places = self.now.points[k][None]
        else:
            places = given.apart(self._drawn(k), self.wavelength / 8)
        places, spreads = given.polished(places)
        told = given.told(places) + 0.5 * torch.linalg.slogdet(spreads)[1]
        top = int(told.argmax())
        apart = places - places[top]
        same = ((apart @ torch.linalg.inv(spreads[top])) * apart).sum(1) < SAME**2
        same |= apart.norm(dim=1) < self.wavelength / 8
        if 1 / (1 + float((told[~same] - told[top]).exp().sum())) < CLEAR:
            return
        points, covariance = self.now.points.clone(), self.now.covariance.clone()
        points[k], covariance[k], self.pinned[k] = places[top], spreads[top], True
        self.now = Open(points, covariance)
        self.terms[k] = self._term(k)

    def _drawn(self, k: int) -> Tensor:
        """Places (m, 3) that the rays allow for source k, their mean first."""
        width = torch.linalg.eigvalsh(self.prior.covariance[k]).clamp_min(0).sqrt()
        cells = float((1 + 16 * width / self.wavelength).prod())
        count = int(min(max(PER_CELL * cells, LEAST_DRAWN), MOST_DRAWN))
        draw = torch.randn(count, 3, generator=self.generator, dtype=torch.float64)
        draw[0] = 0
        return self.prior.points[k] + draw @ self.prior.lower[k].T


@dataclass(frozen=True)
class Given:
    """What all other sources leave for one, at the n rows that see it.

    Attributes:
        rows: these.
        inverse: (n, n), of their covariance by the others and noise.
        alpha: (n, R), its product with what was measured.
        power: of the one.
        centre, tight: mean (3,) [m] and inverse covariance (3, 3) of its place by the rays.
    """

    rows: Rows
    inverse: Tensor
    alpha: Tensor
    power: float
    centre: Tensor
    tight: Tensor

    @staticmethod
    def of(pinning: Pinning, k: int, factor: Factor) -> Given:
        """Of source k, where this is the factor without it."""
        sees = torch.nonzero(pinning.seen[:, k] > 0).flatten()
        return Given(
            pinning.rows.take(sees),
            factor.inverse[sees[:, None], sees],
            factor.alpha[sees],
            float(pinning.power[k]),
            pinning.prior.points[k],
            torch.linalg.inv(pinning.prior.covariance[k]),
        )

    def told(self, points: Tensor) -> Tensor:
        """Log posterior (m,) float64 of places (m, 3), up to a constant."""
        waves = steering(self.rows, points)
        heard = (waves.mH @ self.alpha).abs().square().sum(1)
        scale = 1 + self.power * (waves.conj() * (self.inverse @ waves)).real.sum(0)
        offset = points - self.centre
        rays = 0.5 * ((offset @ self.tight) * offset).sum(1)
        return (self.power * heard / scale - self.alpha.shape[1] * scale.log()).double() - rays

    def apart(self, points: Tensor, distance: float) -> Tensor:
        """The best `POLISHED` of some places, `distance` [m] from each other."""
        told = self.told(points)
        best: list[Tensor] = []
        while len(best) < POLISHED and float(told.max()) > -torch.inf:
            best.append(points[int(told.argmax())])
            told[(points - best[-1]).norm(dim=1) < distance] = -torch.inf
        return torch.stack(best)

    def polished(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Places (m, 3) after steps of Gauss and Newton under the best gain, and covariances (m, 3, 3)."""
        best, reach = self.told(points), torch.ones(len(points), dtype=torch.float64)
        for _ in range(STEPS):
            step, _ = self._step(points)
            tried = points + reach[:, None] * step
            told = self.told(tried)
            better = told > best
            points, best = torch.where(better[:, None], tried, points), torch.where(better, told, best)
            reach = torch.where(better, 1.0, reach / 3)
        return points, self._step(points)[1]

    def _step(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Full steps (m, 3) from places (m, 3), and covariances (m, 3, 3) by Fisher's information."""
        waves = steering(self.rows, points)  # (n, m)
        pulled = self.inverse @ waves
        known = (waves.conj() * pulled).real.sum(0) + 1 / self.power
        gain = (waves.mH @ self.alpha) / known[:, None]  # (m, R)
        turns = slopes(points, self.rows.position, self.rows.frequency).float()  # (m, n, 3)
        slope = waves.T[:, :, None] * turns * -1j
        along = torch.einsum("nm,mnc->mc", pulled.conj(), slope)
        seen = self.inverse @ slope - pulled.T[:, :, None] * (along / known[:, None])[:, None]
        loud = gain.abs().square().sum(1)[:, None, None]
        fisher = 2 * (loud * (slope.mH @ seen).real).double()
        left = self.alpha - pulled.T[:, :, None] * gain[:, None]  # K^-1 (y - a g), (m, n, R)
        pull = 2 * torch.einsum("mnc,mnr,mr->mc", slope.conj(), left, gain.conj()).real.double()
        pull = pull - (points - self.centre) @ self.tight
        covariance = torch.linalg.inv(fisher + self.tight)
        return torch.einsum("mcd,md->mc", covariance, pull), covariance


def _factor(covariance: Tensor, noise: float, rows: Rows) -> Factor:
    loud = max(1.0, float(covariance.diagonal().real.mean()))
    covariance.diagonal().add_(noise + JITTER * loud)
    return Factor.of(covariance, rows.target)

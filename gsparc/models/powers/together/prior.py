"""The prior of powers between any two ends: terms that the site shares, and a process of each end's own.

`P = law + end's level and exponent + w . extinctions + g(place) + r_end(place) + noise`: Gaussians on a grid
take or give decibels along the path between the ends (P. Agrawal and N. Patwari, "Correlated link shadow
fading in multi-hop wireless networks", IEEE Trans. Wireless Commun. 8 (2009)); g, of a moving end's place, is
the same for all stations, as street and crowd are; r has two lengths.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsparc.models.powers.extinction import Blockers, extinctions
from gsparc.models.powers.together.law import SiteLaw
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import apart, matern32, matern_sum

JITTER = 1e-6  # of a correlation's diagonal
TALL = 1e4  # of a Gaussian of the grid, in its widths: places' heights hardly differ against it
LENGTHS = 2  # of an end's own process
OWN = 2 * LENGTHS + 1  # settings of an end: logarithms of lengths [m], variances and the noise's [dB^2]
NAMES = ("own", "departures", "log_length", "log_shared", "log_cloud")


@dataclass(frozen=True)
class Prior:
    """Settings; tensors are float64, variances in dB^2.

    Attributes:
        law: of distance.
        own: (OWN,) of an end never heard: logarithms of its process's lengths [m], of the variances of
            its parts, and of the noise's.
        departures: (T, OWN) of each end from these.
        log_length, log_shared: () length [m] and variance of g.
        log_cloud: () variance of what one Gaussian takes straight through it.
        inducing: (M, 3) places that g is known at [m]; M = 0: there is no g.
        blockers: of the grid; none: nothing stands in the way.
        bend_db: deviation of what a bend of the law takes a decade from the middle [dB]; 0: it is straight.
    """

    law: SiteLaw
    own: Tensor
    departures: Tensor
    log_length: Tensor
    log_shared: Tensor
    log_cloud: Tensor
    inducing: Tensor
    blockers: Blockers
    bend_db: float = 0.0

    @property
    def columns(self) -> int:
        """Of what the site shares."""
        return len(self.inducing) + len(self.blockers) + (self.bend_db > 0)

    def settings(self) -> dict[str, Tensor]:
        """Those that are learned."""
        return {name: getattr(self, name) for name in NAMES}

    def without(self, place: bool = True, cloud: bool = True, bend: bool = True) -> Prior:
        """The same less shared terms."""
        return replace(
            self,
            inducing=self.inducing[:0] if place else self.inducing,
            blockers=Blockers.none() if cloud else self.blockers,
            bend_db=0.0 if bend else self.bend_db,
        )

    def settings_of(self, station: int) -> Tensor:
        """(OWN,) of one end; negative: of one that was never heard."""
        return self.own + self.departures[station] if station >= 0 else self.own

    def process(self, station: int, one: Tensor, other: Tensor) -> Tensor:
        """Covariance (a, b) of an end's own process between places (a, 3) and (b, 3)."""
        settings = self.settings_of(station)
        return matern_sum(apart(one, other), list(settings[:LENGTHS].exp()), list(settings[LENGTHS:-1].exp()))

    def noise(self, station: int) -> Tensor:
        """Variance () of an end's noise."""
        return self.settings_of(station)[-1].exp()

    def variance(self, station: int) -> Tensor:
        """Variance () of an end's own process and noise."""
        return self.settings_of(station)[LENGTHS:].exp().sum()

    def shared(self, moving: Tensor, decades: Tensor, shadows: Tensor) -> tuple[Tensor, Tensor]:
        """Columns (n, P) of the shared terms for unit normal weights, and what g lacks there (n,) [dB^2].

        Args:
            moving: (n, 3) [m].
            decades: (n,) see `SiteLaw`.
            shadows: (n, N) of the grid's Gaussians, see `shadows`.
        """
        columns = self.log_cloud.mul(0.5).exp() * shadows
        if self.bend_db:
            columns = torch.cat([columns, self.bend_db * self.law.bend(decades)[:, None]], 1)
        if not len(self.inducing):
            return columns, torch.zeros_like(moving[:, 0])
        among = self._place(self.inducing, self.inducing) + JITTER * torch.eye(len(self.inducing)).to(moving)
        known = Factor.of(among, "raise").whitened(self._place(self.inducing, moving)).T
        lacks = (1 - known.square().sum(1)).clamp_min(0.0)
        deviation = self.log_shared.mul(0.5).exp()
        return torch.cat([deviation * known, columns], 1), self.log_shared.exp() * lacks

    def shadows(self, moving: Tensor, still: Tensor) -> Tensor:
        """(n, N) of the grid's Gaussians on paths between ends (n, 3) [m]; straight through one is 1."""
        if not len(self.blockers):
            return moving.new_zeros(len(moving), 0)
        return extinctions(moving, still, **vars(self.blockers))

    def _place(self, one: Tensor, other: Tensor) -> Tensor:
        return matern32(apart(one, other), self.log_length.exp())

    def state(self) -> dict[str, Any]:
        """Tensors and numbers that `restored_prior` needs."""
        law = [*vars(self.law).values()]
        return {
            **self.settings(),
            "inducing": self.inducing,
            "law": law,
            "blockers": vars(self.blockers),
            "bend_db": self.bend_db,
        }


def restored_prior(state: Mapping[str, Any]) -> Prior:
    """The prior whose `state()` this was."""
    law = SiteLaw(*(float(value) for value in state["law"]))
    blockers = Blockers(**state["blockers"])
    return Prior(
        law,
        **{name: state[name] for name in NAMES},
        inducing=state["inducing"],
        blockers=blockers,
        bend_db=float(state["bend_db"]),
    )


def grid(low: Tensor, high: Tensor, most: int) -> Blockers:
    """Round upright Gaussians on a square grid over a box (3,), (3,) [m], at most so many.

    Their deviations are half of their spacing: the sum of equal ones is flat.
    """
    size = (high - low)[:2].clamp_min(1e-3)
    spacing = math.sqrt(float(size.prod()) / most)
    spacing = max(spacing, float(size.max()) / most)
    count = (size / spacing).floor().long().clamp_min(1)
    axes = [
        float(low[k]) + (torch.arange(int(count[k]), dtype=torch.float64) + 0.5) * float(size[k] / count[k])
        for k in range(2)
    ]
    x, y = torch.meshgrid(*axes, indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), float(low[2] + high[2]) / 2)], 1)
    width = torch.full_like(means, spacing / 2)
    width[:, 2] *= TALL
    return Blockers(means.double(), width.double().log(), torch.zeros(len(means), dtype=torch.float64))

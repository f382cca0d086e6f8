"""Gaussians that stand in the way: terms of the mean law of powers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gsparc.multipath.powers.extinction import extinctions
from gsparc.processes.trend import Trend

Place = tuple[float, float, float]


@dataclass(frozen=True)
class Blockers:
    """N Gaussians that paths lose power in.

    Attributes:
        means: (N, 3) float64 [m].
        log_scales: (N, 3) of their standard deviations along their own axes, the third upwards [m].
        turns: (N,) angles from x to their first axes [rad].
        log_strengths: (N,) of the prior's deviation of what each takes of a path straight through it, of the
            square root of the process's amplitude.
        most: () that each takes of one path, in units of the way straight through it.
    """

    means: Tensor
    log_scales: Tensor
    turns: Tensor
    log_strengths: Tensor
    most: Tensor = field(default=torch.tensor(math.inf, dtype=torch.float64), kw_only=True)

    @classmethod
    def none(cls) -> Blockers:
        """No Gaussians."""
        flat = torch.zeros(0, dtype=torch.float64)
        return cls(flat.view(0, 3), flat.view(0, 3), flat, flat)

    def __len__(self) -> int:
        return len(self.means)

    def relative_to(self, amplitude: float) -> Blockers:
        """The same, when strengths are in decibels, in units of a process's amplitude [dB^2]."""
        return replace(self, log_strengths=self.log_strengths - 0.5 * math.log(amplitude))

    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What each of them has of its own."""
        return self.means, self.log_scales, self.turns, self.log_strengths

    def shadows(self, places: Tensor, still: Place | None) -> Tensor:
        """What they take (n, N) of one path each, by `extinctions`, without their strengths.

        Args:
            places: (n, 3) of the moving end, or (n, 6) of both [m].
            still: of the end that stands [m]; None where both move.
        """
        other = places[:, 3:] if still is None else places.new_tensor(still).expand(len(places), 3)
        taken = extinctions(places[:, :3], other, self.means, self.log_scales, self.turns)
        return taken.minimum(self.most)

    def terms(self, places: Tensor, still: Place | None) -> Tensor:
        """The same (n, N) times their strengths: columns of the covariance's low-rank term."""
        return self.log_strengths.exp() * self.shadows(places, still)


@dataclass(frozen=True)
class ShadowedTrend(Trend):
    """A mean law of powers with Gaussians among what is uncertain of it.

    Attributes:
        blockers: the Gaussians.
        still: of the end that stands [m]; None where both move.
    """

    blockers: Blockers | None = None
    still: Place | None = None

    @classmethod
    def over(cls, trend: Trend, blockers: Blockers, still: Place | None) -> ShadowedTrend:
        """Gaussians beside a constant or a distance law."""
        return cls(trend.level, trend.law, trend.middle, trend.spread, blockers, still)

    def terms(self, places: Tensor) -> Tensor:
        """What is uncertain of the mean: (n, P) of the law, then (n, N) of the Gaussians."""
        law = super().terms(places)
        if not self.blockers:
            return law
        return torch.cat([law, self.blockers.terms(places, self.still)], 1)

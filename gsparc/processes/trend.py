"""The mean law of powers, and what of it is uncertain: losses in known walls among it.

The multi-wall model (COST Action 231, "Digital mobile radio towards future generation systems",
final report, 1999, section 4.7.2): one loss for each wall, another for each floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsparc.processes.places import first_end, other_end
from gsparc.processes.stored import Stored
from gsparc.processes.term import Columns

TINY_M = 1e-6  # distance that has a logarithm
# Decades: rows at nearly one distance say nothing of a slope that holds far away
LEAST_SPREAD = 0.1
LEVEL = 0.7  # upward part of a floor's normal


@dataclass(frozen=True)
class Law(Stored):
    """`P [dB] = level - 10 exponent log10(max(distance, floor))`.

    >>> law = Law(level=-40.0, exponent=2.0, floor=1.0, scale=6.0, place=(0.0, 0.0, 0.0))

    At 10 m, and nearer than the floor:

    >>> law.mean(torch.tensor([[10.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    tensor([-60., -40.])

    Attributes:
        level: at 1 m [dB of stored units].
        exponent: n.
        floor: d0 [m].
        scale: of the residuals' density [dB].
        place: of the still end, local [m]; None where both ends move and places are (n, 6).
    """

    level: float
    exponent: float
    floor: float
    scale: float
    place: tuple[float, float, float] | None

    def _squared_distance(self, places: Tensor) -> Tensor:
        still = other_end(places) if self.place is None else places.new_tensor(self.place)
        return (first_end(places) - still).square().sum(1).clamp_min(max(self.floor, TINY_M) ** 2)

    def distance(self, places: Tensor) -> Tensor:
        """Return the distance [m], floored, (n,) at (n, 3), or of both ends (n, 6) [m]."""
        return self._squared_distance(places).sqrt()

    def decades(self, places: Tensor) -> Tensor:
        """Return log10 of `distance` in metres (n,)."""
        # Half the logarithm of the square: the root, whose slope at 0 is infinite, is never taken.
        return 0.5 * torch.log10(self._squared_distance(places))

    def mean(self, places: Tensor) -> Tensor:
        """Return powers (n,) [dB] at places (n, 3) or (n, 6) [m], with autograd."""
        return self.level - 10 * self.exponent * self.decades(places)


@dataclass(frozen=True)
class Walls(Columns):
    """Losses in Q rectangles, boxes as six each: one weight for walls, another for floors.

    >>> axes = torch.tensor([[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]])  # normal along x
    >>> corner, size = torch.tensor([[2.0, 0, 0]]), torch.tensor([[4.0, 3.0]])
    >>> wall = Walls(axes, corner, size, still=torch.tensor([0, 1.0, 1.0]))

    Behind the wall x = 2, and before it:

    >>> wall.columns(torch.tensor([[5.0, 1.0, 1.0], [1.0, 1.0, 1.0]]))
    tensor([[1., 0.],
            [0., 0.]])

    Attributes:
        axes: (Q, 3, 3) float64, of each its normal and two tangents.
        corners: (Q, 3) lowest coordinates along these [m].
        sizes: (Q, 2) along the tangents [m].
        still: (3,) the end that stands [m]; (0,) where both move.
        loss_db: deviation of a wall's loss before any row [dB].
        unit: deviation of the process [dB], which columns are relative to.
    """

    axes: Tensor
    corners: Tensor
    sizes: Tensor
    still: Tensor
    loss_db: float = 1.0  # of the process's deviation in older files
    unit: float = 1.0

    def columns(self, places: Tensor) -> Tensor:
        """Count walls and floors (n, 2) on paths to places (n, 3), or between both ends (n, 6)
        [m].
        """
        other = self.still.expand(len(places), -1) if len(self.still) else other_end(places)
        start, end = (
            (at @ self.axes.flatten(0, 1).T).view(len(places), -1, 3) - self.corners
            for at in (first_end(places), other)
        )
        difference = (start - end)[..., :1]
        # Where a path meets the wall's plane; a path along the plane is divided by 1,
        # and never counts.
        met = start + start[..., :1] / torch.where(difference == 0, 1.0, difference) * (end - start)
        inside = ((met[..., 1:] >= 0) & (met[..., 1:] <= self.sizes)).all(-1)
        hit = (inside & (start[..., 0] * end[..., 0] < 0)).to(places)
        level = self.axes[:, 0, 2].abs() > LEVEL
        counts = torch.stack([hit[:, ~level].sum(1), hit[:, level].sum(1)], 1)
        return counts * (self.loss_db / self.unit)


@dataclass(frozen=True)
class Trend(Columns):
    """The mean of powers, and what of it is uncertain.

    >>> Trend(level=-70.0).mean(torch.zeros(2, 3))
    tensor([-70., -70.])

    Attributes:
        level: the mean where there is no law [dB].
        law: the distance law, or None.
        middle, spread: of the rows' decades of distance their mean, and the number of decades over
            which the uncertain slope changes powers by one unit.
        more: further terms with uncertain weights, such as losses in known walls.
        level_db: deviation of the level before any row [dB].
        unit: deviation of the process [dB], which columns are relative to; of both 1 in trends
            whose deviations are the process's own.
    """

    level: float
    law: Law | None = None
    middle: float = 0.0
    spread: float = 1.0
    more: tuple[Columns, ...] = ()
    level_db: float = 1.0
    unit: float = 1.0

    @classmethod
    def from_law(cls, law: Law, places: Tensor) -> Trend:
        """Return a trend about a law that was fitted to rows at places (n, 3) or (n, 6)
        float64 [m].
        """
        decades = law.decades(places)
        return cls(
            0.0, law, float(decades.mean()), max(float(decades.std(correction=0)), LEAST_SPREAD)
        )

    def in_unit(self, deviation: float) -> Trend:
        """Return the same of a process of this deviation [dB]."""
        more = tuple(
            replace(term, unit=deviation) if hasattr(term, "unit") else term  # type: ignore[type-var]
            for term in self.more
        )
        return replace(self, unit=deviation, more=more)

    def mean(self, places: Tensor) -> Tensor:
        """Return powers (n,) [dB] at places (n, 3) or (n, 6) [m]."""
        mean = (
            places.new_full((len(places),), self.level)
            if self.law is None
            else self.law.mean(places)
        )
        return sum((term.mean(places) for term in self.more), mean)

    def mean_and_columns(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean (n,) and `columns` (n, Q)."""
        return self.mean(places), self.columns(places)

    def columns(self, places: Tensor) -> Tensor:
        """Return what is uncertain of the mean (n, Q): constant, slope,
        and what `more` terms have.
        """
        parts = [torch.full_like(places[:, :1], self.level_db / self.unit)]
        if self.law is not None:
            # Centred, so that slope and level are nearly independent.
            decades = self.law.decades(places)[:, None] - self.middle
            parts.append(decades / (self.spread * self.unit))
        return torch.cat([*parts, *(term.columns(places) for term in self.more)], 1)

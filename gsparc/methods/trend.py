"""The mean law of powers, and what of it is uncertain."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import torch
from torch import Tensor

from gsparc.methods.distance_law import Law, Rows

REACH = 0.25  # diagonals of the known places, by which a law's confidence falls to 1/e


@dataclass(frozen=True)
class Trend:
    """The mean of powers, and what of it is uncertain.

    Attributes:
        level: the mean where there is no law [dB].
        law: the distance law, or None.
        middle, spread: mean and deviation of the rows' decades of distance: its slope is uncertain in these.
    """

    level: float
    law: Law | None = None
    middle: float = 0.0
    spread: float = 1.0

    @classmethod
    def of(cls, rows: Rows, law: Law | None) -> Trend:
        """About a law; about the mean of what was heard where that is None."""
        used = ~rows.silent if not rows.silent.all() else rows.silent
        if law is None:
            return cls(float(rows.decibels[used].mean()))
        decades = law.decades(torch.from_numpy(rows.places))
        return cls(0.0, law, float(decades.mean()), max(float(decades.std(correction=0)), 1e-6))

    def mean(self, places: Tensor) -> Tensor:
        """Powers (n,) [dB] at places (n, 3) or (n, 6) [m]."""
        return places.new_full((len(places),), self.level) if self.law is None else self.law.mean(places)

    def terms(self, places: Tensor) -> Tensor:
        """What is uncertain of the mean: (n, 1), a constant, or (n, 2), also the slope of the law."""
        one = torch.ones_like(places[:, :1])
        if self.law is None:
            return one
        return torch.cat([one, (self.law.decades(places)[:, None] - self.middle) / self.spread], 1)

    def state(self) -> dict[str, Any]:
        """Numbers that `trend_of` needs."""
        law = self.law
        return {
            "trend": [self.level, self.middle, self.spread],
            "law": [] if law is None else [*astuple(law)[:4]],
            "law_place": [] if law is None or law.place is None else [*law.place],
        }


def trend_of(state: dict[str, Any]) -> Trend:
    """The trend whose `state()` this was."""
    values, place = [float(v) for v in state["law"]], [float(v) for v in state["law_place"]]
    at = (place[0], place[1], place[2]) if place else None
    law = Law(values[0], values[1], values[2], values[3], at) if values else None
    level, middle, spread = (float(v) for v in state["trend"])
    return Trend(level, law, middle, spread)

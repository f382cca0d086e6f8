"""What powers of all stations of a site share beside their mean law, as columns of unit normal weights.

`P = law + b decades + c decades^2 + w . shadows + g(place) + r_station + noise`: the law's exponent
is corrected, and bent; Gaussians on a grid take or give decibels along the path between the ends (P. Agrawal
and N. Patwari, "Correlated link shadow fading in multi-hop wireless networks", IEEE Trans. Wireless Commun. 8
(2009)); g, of a moving end's place, is the same for all stations, as street and crowd are. r is the process
of a station's own (`learning.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.models.powers.together.rows import LinkRows
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import apart, matern32
from gsparc.processes.trend import Trend

LAW_DB = (5.0, 5.0)  # deviations a decade from the middle, of a slope and of a bend
JITTER = 1e-6  # of a correlation's diagonal
TALL = 1e4  # of a Gaussian of the grid, in its widths: it takes as much at all heights
CELLS = (16, 600)  # Gaussians of the grid, fewest and most
ROWS_A_CELL = 8


@dataclass(frozen=True)
class Terms:
    """Shared terms; tensors are float64.

    Attributes:
        trend: the mean law, with the middle of its decades.
        nearest, farthest: decades of what was heard, of the middle; beyond, the law bends no more.
        inducing: (M, 3) places that g is known at [m].
        length: of g [m].
        cells: (N, 3) middles of the grid's Gaussians [m].
        width: their standard deviation along the ground [m].
        place_db, shadow_db: deviations of g, and of what a Gaussian takes straight through it; 0: none.
    """

    trend: Trend
    nearest: float
    farthest: float
    inducing: Tensor
    length: float
    cells: Tensor
    width: float
    place_db: float = 0.0
    shadow_db: float = 0.0

    @classmethod
    def over(cls, rows: LinkRows, trend: Trend, length: float, places: int, seed: int) -> Terms:
        """With g known at so many places of rows, drawn evenly, and a grid over both ends; all of 0 dB."""
        at = torch.from_numpy(rows.places)
        decades = _decades(trend, at)
        ends = np.concatenate([rows.places[:, :3], rows.places[:, 3:]])
        count = min(max(len(ends) // 2 // ROWS_A_CELL, CELLS[0]), CELLS[1])
        cells, width = grid(ends.min(0), ends.max(0), count)
        none = torch.zeros(0, 3, dtype=torch.float64)
        found = cls(trend, float(decades.min()), float(decades.max()), none, length, cells, width)
        return found.known_at(rows, places, seed)

    def known_at(self, rows: LinkRows, most: int, seed: int) -> Terms:
        """The same with g known at so many places of rows, drawn evenly."""
        every = np.unique(rows.places[:, :3], axis=0)
        drawn = np.random.default_rng(seed).permutation(len(every))[:most]
        return replace(self, inducing=torch.from_numpy(every[np.sort(drawn)]))

    @property
    def there(self) -> bool:
        """Whether there are any beside the law's."""
        return bool(self.place_db or self.shadow_db)

    @property
    def count(self) -> int:
        """Gaussians in the way."""
        return len(self.cells) if self.shadow_db else 0

    def scale(self) -> Tensor:
        """Deviations (P,) [dB] of the weights of `units`."""
        parts = zip((self.shadow_db, self.place_db), (len(self.cells), len(self.inducing)), strict=True)
        return torch.tensor([*LAW_DB] + [each for one, many in parts for each in [one] * many]).double()

    def units(self, places: Tensor) -> Tensor:
        """All columns (n, P) of 1 dB at places of both ends (n, 6) [m]."""
        shadows = crossed(places, self.cells, self.width)
        known = self._factor.whitened(matern32(apart(self.inducing, places[:, :3]), self.length)).T
        return torch.cat([self._of_law(places), shadows, known], 1)

    def columns(self, places: Tensor) -> Tensor:
        """Those of the terms that are there (n, P) [dB] at places of both ends (n, 6) [m]."""
        parts = [self._of_law(places) * torch.tensor(LAW_DB, dtype=torch.float64)]
        if self.shadow_db:
            parts.append(self.shadow_db * crossed(places, self.cells, self.width))
        if self.place_db:
            near = matern32(apart(self.inducing, places[:, :3]), self.length)
            parts.append(self.place_db * self._factor.whitened(near).T)
        return torch.cat(parts, 1)

    @cached_property
    def _factor(self) -> Factor:
        gram = matern32(apart(self.inducing, self.inducing), self.length)
        gram.diagonal().add_(JITTER)
        return Factor.of(gram, "raise")

    def _of_law(self, places: Tensor) -> Tensor:
        decades = _decades(self.trend, places)
        inside = decades.clamp(self.nearest, self.farthest)
        bend = inside.square() + 2 * inside * (decades - inside)
        return torch.stack([decades, bend], 1)

    def state(self) -> dict[str, Any]:
        """Tensors and numbers that `Terms` takes, but for the trend."""
        return {name: value for name, value in vars(self).items() if name not in ("trend", "_factor")}


def _decades(trend: Trend, places: Tensor) -> Tensor:
    assert trend.law is not None
    return trend.law.decades(places) - trend.middle


def crossed(places: Tensor, cells: Tensor, width: float) -> Tensor:
    """(n, N) of Gaussians on the paths between both ends (n, 6) [m]; the way straight through one counts 1.

    With the start p and the way q of a path in standard deviations from a Gaussian, the exponent
    -|p + t q|^2 / 2 is a parabola in t: its integral over [0, 1] is a difference of error functions.
    """
    start = (places[:, None, :2] - cells[:, :2]) / width
    way = ((places[:, 3:5] - places[:, :2]) / width)[:, None]
    squared = way.square().sum(-1).clamp_min(1e-12)
    along = (start * way).sum(-1) / squared
    closest = (start.square().sum(-1) - along.square() * squared).clamp_min(0.0)
    size = (squared / 2).sqrt()
    return 0.5 * torch.exp(-0.5 * closest) * (torch.erf((1 + along) * size) - torch.erf(along * size))


def grid(low: np.ndarray, high: np.ndarray, most: int) -> tuple[Tensor, float]:
    """Middles (N, 3) of at most so many Gaussians on a square grid over a box (3,), (3,), and their width.

    It is half of their spacing: the sum of equal ones is flat.
    """
    size = np.maximum((high - low)[:2], 1e-3)
    spacing = max(math.sqrt(float(size.prod()) / most), float(size.max()) / most)
    count = np.maximum(np.floor(size / spacing), 1).astype(int)
    axes = [low[k] + (np.arange(count[k]) + 0.5) * size[k] / count[k] for k in range(2)]
    x, y = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    return torch.from_numpy(np.stack([x, y, np.full(len(x), (low[2] + high[2]) / 2)], 1)), spacing / 2

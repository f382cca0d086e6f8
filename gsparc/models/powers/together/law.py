"""The distance law of a site: one exponent and floor for all ends, a level and a departure for each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.models.baselines.distance_law import (
    FLOORS,
    SPREADS_DB,
    TINY_M,
    USUAL,
    Rows,
    fit_line,
)
from gsparc.models.powers.together.rows import Heard

LEVELS_DB, EXPONENTS = 8.0, 0.5  # deviations between ends that are expected before any was heard
WORTH = 2.0  # ends that this counts as
SCALE_DB = 6.0  # of residuals, where a fit starts
FITTED_ON = 2_000  # rows of each end


@dataclass(frozen=True)
class SiteLaw:
    """`P [dB] = level - 10 exponent (log10(max(distance, floor)) - middle)`, and how ends depart from it.

    Attributes:
        level: mean over ends at the middle [dB of stored units].
        exponent: mean over ends.
        floor: [m].
        middle: decades of distance that levels are at.
        levels_db: standard deviation of ends' levels [dB].
        exponents: that of their exponents.
        nearest, farthest: decades of what was heard, of the middle; beyond, the law bends no more.
    """

    level: float
    exponent: float
    floor: float
    middle: float
    levels_db: float
    exponents: float
    nearest: float = -1.0
    farthest: float = 1.0

    def decades(self, moving: Tensor, still: Tensor) -> Tensor:
        """log10 of the floored distance over that of the middle, (n,) between ends (n, 3) [m]."""
        squared = (moving - still).square().sum(-1).clamp_min(max(self.floor, TINY_M) ** 2)
        return 0.5 * torch.log10(squared) - self.middle

    def mean(self, decades: Tensor) -> Tensor:
        """Powers (n,) [dB] of an end that nobody heard."""
        return self.level - 10 * self.exponent * decades

    def bend(self, decades: Tensor) -> Tensor:
        """(n,) what a second slope adds in first order: squared decades; straight beyond the rows."""
        inside = decades.clamp(self.nearest, self.farthest)
        return inside.square() + 2 * inside * (decades - inside)

    def terms(self, decades: Tensor) -> Tensor:
        """(n, 2) [dB]: an end's departures in level and exponent, for unit normal weights."""
        return torch.stack([torch.full_like(decades, self.levels_db), -10 * self.exponents * decades], -1)


def fit_site_law(rows: Heard) -> SiteLaw:
    """The law of largest likelihood, each end with a line of its own; their spread is shrunk to the usual.

    Args:
        rows: at least one.
    """
    parts = [
        rows.at(np.flatnonzero(rows.station == number)[:: _step(rows, number)]) for number in rows.stations
    ]
    far = [np.linalg.norm(part.moving - part.still, axis=1) for part in parts]
    every = np.concatenate(far)
    low, high = np.maximum(np.quantile(every, [0.0, 0.5]), TINY_M)
    best, found = np.inf, (0.0, [np.zeros(3)])
    lines = [_start(part) for part in parts]
    for floor in np.unique(np.geomspace(low, high, FLOORS)):
        fits = []
        for part, one, start in zip(parts, far, lines, strict=True):
            decades = np.log10(np.maximum(one, floor))
            fits.append(fit_line(decades, Rows(part.moving, part.decibels, part.silent), start))
        lines = [line for _, line in fits]
        value = sum(value for value, _ in fits)
        if value < best:
            best, found = value, (float(floor), lines)
    floor, lines = found
    decades = [np.log10(np.maximum(one, floor)) for one in far]
    middle = float(np.concatenate(decades).mean())
    # What an end's own rows say of its exponent: the more, the wider they are spread.
    told = np.array([_information(one, line) for one, line in zip(decades, lines, strict=True)])
    slopes = np.array([line[1] for line in lines])
    weight = 1 / (EXPONENTS**2 + 1 / told)
    exponent = float((weight * slopes).sum() / weight.sum())
    levels = np.array([line[0] - 10 * line[1] * middle for line in lines])
    level = float(np.median(levels)) if len(levels) > 2 else float(levels.mean())
    between = np.maximum((slopes - exponent) ** 2 - 1 / told, 0.0)
    every = np.concatenate(decades) - middle
    return SiteLaw(
        level, exponent, floor, middle, _spread((levels - level) ** 2, LEVELS_DB),
        _spread(between, EXPONENTS), float(every.min()), float(every.max()),
    )  # fmt: skip


def _step(rows: Heard, number: int) -> int:
    return -(-int((rows.station == number).sum()) // FITTED_ON)


def _start(rows: Heard) -> np.ndarray:
    used = ~rows.silent if not rows.silent.all() else rows.silent
    decades = np.log10(np.maximum(np.linalg.norm(rows.moving - rows.still, axis=1), TINY_M))
    level = float(np.median(rows.decibels[used] + 10 * USUAL * decades[used]))
    return np.array([level, USUAL, math.log(min(SCALE_DB, SPREADS_DB[1]))])


def _information(decades: np.ndarray, line: np.ndarray) -> float:
    """Inverse variance of an exponent; neighbours err alike, so that rows count by their square root."""
    count = math.sqrt(len(decades))
    return max(100 * count * float(decades.var()) / math.exp(2 * line[2]), 1e-6)


def _spread(squares: np.ndarray, usual: float) -> float:
    return math.sqrt((WORTH * usual**2 + float(squares.sum())) / (WORTH + max(len(squares) - 1, 0)))

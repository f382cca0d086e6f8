"""Does the promise hold: thresholds from many calibration sets, each tried on positions it never saw."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gsparc.commands.calibrate.curves import bounded, risk_coverage
from gsparc.prediction.confidence_scores import Evidence
from gsparc.prediction.risk_threshold import (
    Promise,
    Threshold,
    binomial_interval,
    choose,
    levels_of,
    spread_out,
)

How = Literal["random", "spatial"]
SHARES = (0.2, 0.4)  # of the positions that choose the kind and the levels, and that calibrate
MOST_LAX_DB = 6  # limit of an error that a hint may name: twice as large as what is predicted
CELLS = 6  # along each horizontal side; whole cells are calibrated on or tested


@dataclass(frozen=True)
class Trial:
    """What many calibration sets led to.

    Attributes:
        kind: confidence used.
        how: how positions were divided.
        realised: (draws,) share of bad ones among accepted test positions; NaN where none was accepted.
        coverage: (draws,) share of test positions accepted.
        alpha, delta: as promised.
    """

    kind: str
    how: How
    realised: np.ndarray
    coverage: np.ndarray
    alpha: float
    delta: float

    @property
    def silent(self) -> float:
        """Share of draws in which nobody was accepted: nothing was promised, so nothing was kept."""
        return float(np.isnan(self.realised).mean())

    @property
    def _spoke(self) -> np.ndarray:
        return self.realised[~np.isnan(self.realised)]

    @property
    def broken(self) -> float | None:
        """Share of draws in which more than alpha were bad, of those that accepted anybody; None of none.

        The promise is delta of *all* draws (`broken_of_all`). Where most accept nobody, those that do are
        the ones that chance flattered, and this share is larger.
        """
        return float((self._spoke > self.alpha).mean()) if len(self._spoke) else None

    @property
    def broken_of_all(self) -> float:
        """Share of all draws in which more than alpha of the accepted were bad: what delta bounds."""
        return float((self.realised > self.alpha).mean())  # NaN > alpha is False

    @property
    def interval(self) -> tuple[float, float] | None:
        """Clopper and Pearson's 95 % interval of `broken`, as if the draws were independent.

        They share their positions, so this is the least that chance allows for.
        """
        spoke = self._spoke
        return binomial_interval(int((spoke > self.alpha).sum()), len(spoke)) if len(spoke) else None

    @property
    def mean_realised(self) -> float | None:
        """Mean share of bad ones among accepted test positions."""
        return None if np.isnan(self.realised).all() else float(np.nanmean(self.realised))


def divided(
    evidence: Evidence, how: How, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disjoint rows of the evidence: to choose on, to calibrate on, to test on.

    `spatial` deals out whole cells of the plane, so that a test position has no calibrated neighbour but
    across a cell's border.

    Raises:
        ValueError: too few positions, or patches, for three parts.
    """
    unit = _units(evidence, how)
    order = rng.permutation(unit.max(initial=-1) + 1)
    first, second = _cuts(len(order))
    if not 0 < first < second < len(order):
        what = "positions" if how == "random" else "patches of the plane"
        raise ValueError(
            f"{len(order)} {what} cannot be parted into those to choose on, to calibrate on and to test on: "
            f"take more test rows{'' if how == 'random' else ', or spatial=false'}"
        )
    parts = order[:first], order[first:second], order[second:]
    choose_on, calibrate, test = (np.flatnonzero(np.isin(unit, part)) for part in parts)
    return choose_on, calibrate, test


def divisible(evidence: Evidence, how: How) -> bool:
    """Whether `divided` has three parts to give."""
    count = int(_units(evidence, how).max(initial=-1)) + 1
    first, second = _cuts(count)
    return 0 < first < second < count


def too_few(count: int, promise: Promise) -> str | None:
    """What is missing for any promise on so many positions; None where there are enough."""
    needed = int(np.ceil(promise.least / SHARES[1]))
    if count >= needed:
        return None
    return (
        f"{count} test positions can promise nothing: alpha={promise.alpha:g}, delta={promise.delta:g} need "
        f"{promise.least} good ones to calibrate on, {needed} in all; measure more, or promise less"
    )


def laxer(evidence: Evidence, promise: Promise, kind: str, spatial: bool, seed: int) -> Promise | None:
    """The same promise with the least larger limit, in whole decibels, that these positions keep; or None."""
    for limit in range(int(np.floor(promise.limit_db)) + 1, MOST_LAX_DB + 1):
        other = replace(promise, limit_db=float(limit))
        if np.isfinite(accept(evidence, other, kind, spatial, seed)[1].value):
            return other
    return None


def _units(evidence: Evidence, how: How) -> np.ndarray:
    """What each position (n,) is dealt out with: itself, or its patch."""
    return np.arange(len(evidence)) if how == "random" else cells(evidence.position)


def _cuts(count: int) -> tuple[int, int]:
    first, second = (round(share * count) for share in np.cumsum(SHARES))
    return first, second


def cells(position: np.ndarray) -> np.ndarray:
    """Which patch of the plane each position (n, 3) lies in: (n,) numbers from 0; on a plumb line, of it."""
    flat = position[:, :2] if np.ptp(position[:, :2], axis=0).any() else position[:, [2, 2]]
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    cell = np.minimum((flat - low) / np.where(extent > 0, extent, 1) * CELLS, CELLS - 1).astype(int)
    return np.unique(cell @ np.array([CELLS, 1]), return_inverse=True)[1].ravel()


def best_kind(evidence: Evidence, rows: np.ndarray) -> str:
    """The confidence of the smallest area under risk-coverage on `rows`."""
    loss = bounded(evidence.error[rows])
    return min(evidence.scores, key=lambda kind: risk_coverage(evidence.scores[kind][rows], loss).area)


def accept(
    evidence: Evidence, promise: Promise, kind: str, spatial: bool, seed: int | list[int], apart_m: float = 0
) -> tuple[str, Threshold, np.ndarray, np.ndarray]:
    """Confidence, threshold, and positions (indices of the evidence): unseen by both, and set aside.

    Raises:
        ValueError: `kind` is no confidence of this evidence.
    """
    rng = np.random.default_rng(seed)
    choose_on, calibrate, test = divided(evidence, "spatial" if spatial else "random", rng)
    used = best_kind(evidence, choose_on) if kind == "auto" else kind
    if used not in evidence.scores:
        raise ValueError(f"confidence={used}: expected auto or {', '.join(evidence.scores)}")
    score, bad = evidence.scores[used], promise.bad(evidence.error)
    calibrate = spread_out(evidence.position, calibrate, apart_m, rng)
    patch = cells(evidence.position)[calibrate] if spatial else None
    found = choose(score[calibrate], bad[calibrate], levels_of(score[choose_on]), promise, patch)
    return used, found, test, choose_on


def trials(
    evidence: Evidence, promise: Promise, how: How, draws: int, kind: str = "auto", apart_m: float = 0.0,
    seed: int = 0,
) -> Trial:  # fmt: skip
    """Resample `draws` calibration sets.

    Args:
        evidence: positions the method did not learn from.
        promise: what every threshold promises.
        how: `random` or `spatial` division.
        draws: calibration sets.
        kind: a confidence, or `auto`: the best on the positions set aside for choosing.
        apart_m: calibration positions nearer to each other than this are thinned [m].
        seed: of the draws.
    """
    realised, coverage, kinds = [], [], []
    bad = promise.bad(evidence.error)
    for draw in range(draws):
        used, found, test, _ = accept(evidence, promise, kind, how == "spatial", [seed, draw], apart_m)
        taken = test[evidence.scores[used][test] >= found.value]
        kinds.append(used)
        realised.append(bad[taken].mean() if len(taken) else np.nan)
        coverage.append(len(taken) / max(len(test), 1))
    most = max(set(kinds), key=kinds.count)
    return Trial(most, how, np.array(realised), np.array(coverage), promise.alpha, promise.delta)

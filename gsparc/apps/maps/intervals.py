"""Intervals that hold a measurement as often as they say, learned from whole blocks of places held out.

The field alone, without the noise of a measurement, lies in them more often.
A prediction's own deviation is scaled by what it took to cover the errors of held-out rows as far from data
(split conformal prediction with a scale, J. Lei et al., J. Amer. Stat. Assoc. 113 (2018), in bins of
distance). Farther than any held-out row nothing is known, and nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import norm
from sklearn.isotonic import IsotonicRegression

LEAST_ROWS = 40  # held out, for any promise
ROWS_OF_A_BIN, BLOCKS_OF_A_BIN = 150, 8
MOST_BINS = 8
PARTS = 5  # of blocks, that are calibrated without by turns
ENOUGH_BLOCKS = 10  # from which a station's own errors count more than those of all
REACH = 0.99  # quantile of the held-out rows' distances that is the farthest anything is said of
LEAST_SPREAD = 0.1  # of the median deviation: of a station with few rows some are next to 0
COMPLETED = 100  # passes over censored rows
TAIL = np.concatenate([[0.001, 0.002, 0.005], np.linspace(0.01, 0.99, 99), [0.995, 0.998, 0.999]])


@dataclass(frozen=True)
class HeldOutLevels:
    """Rows predicted by models that did not learn from the block of places around them.

    Attributes:
        level_db: (n,) measured [dB]; of censored rows, the level they lie below or above.
        mean_db, spread_db: (n,) predicted, and its deviation [dB].
        distance: (n,) to the nearest place that was learned from [m].
        block: (n,) int64, rows of one were held out together.
        station: (n,) int64; 0 where there is one.
        side: (n,) int8, 1 where the power lies below its level, -1 where above, 0 where it was measured.
    """

    level_db: np.ndarray
    mean_db: np.ndarray
    spread_db: np.ndarray
    distance: np.ndarray
    block: np.ndarray
    station: np.ndarray
    side: np.ndarray

    def __len__(self) -> int:
        return len(self.level_db)

    def subset(self, rows: np.ndarray) -> HeldOutLevels:
        """Return some of them."""
        return HeldOutLevels(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def error(self) -> np.ndarray:
        """Measured less predicted (n,), in deviations; of censored rows what bounds it."""
        return (self.level_db - self.mean_db) / self.spread_db


@dataclass(frozen=True)
class IntervalScales:
    """What scales a prediction's own deviation.

    Attributes:
        share: of measurements that intervals hold.
        distance: (K,) middles of bins [m].
        half: (K,) half of an interval, in deviations.
        rms: (K,) expected error, in deviations.
        tail: (Q,) quantiles `TAIL` of errors in expected errors; None where censored rows hide some of them.
        reach: beyond this distance nothing is said [m].
        station: (T,) what deviations of each are multiplied with before; of those not among them, 1.
        least: deviation that smaller ones are taken for [dB].
    """

    share: float
    distance: np.ndarray
    half: np.ndarray
    rms: np.ndarray
    tail: np.ndarray | None
    reach: float
    station: np.ndarray
    least: float = 0.0

    def half_and_error(
        self, spread_db: np.ndarray, distance: np.ndarray, station: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return half the interval and the root mean square error (n,) [dB] of stations (n,).

        NaN out of reach.
        """
        own = np.append(self.station, 1.0)[np.minimum(station, len(self.station))]
        scaled = np.where(distance <= self.reach, own * np.maximum(spread_db, self.least), np.nan)
        half, rms = (scaled * np.interp(distance, self.distance, factor) for factor in (self.half, self.rms))
        return half, rms

    def probability_below(
        self, level_db: float | np.ndarray, mean_db: np.ndarray, expected_db: np.ndarray
    ) -> np.ndarray:
        """Return the probability (n,) that a measurement lies below a level; NaN where it is not known."""
        standard = (level_db - mean_db) / expected_db
        if self.tail is None:
            return norm.cdf(standard)
        # Beyond the rarest error that was seen it is rarer still, as of a normal one.
        known, normal = np.interp(standard, self.tail, TAIL), norm.cdf(standard)
        chance = np.where(standard > self.tail[-1], np.maximum(known, normal), known)
        chance = np.where(standard < self.tail[0], np.minimum(known, normal), chance)
        return np.where(np.isfinite(standard), chance, np.nan)


def calibrate(evidence: HeldOutLevels, share: float = 0.9) -> IntervalScales:
    """Learn the scales; their intervals get no narrower with distance.

    Args:
        evidence: of held-out rows.
        share: of measurements that intervals are to hold.

    Raises:
        ValueError: too few rows.
    """
    used = evidence.subset(np.flatnonzero(np.isfinite(evidence.error)))
    heard = used.side == 0
    if heard.sum() < LEAST_ROWS:
        fault = f"{heard.sum()} of them were held out, {LEAST_ROWS} at least are needed"
        raise ValueError(f"too few rows to test intervals ({fault}); promised=false draws without a promise")
    least = LEAST_SPREAD * float(np.median(used.spread_db))
    used = replace(used, spread_db=np.maximum(used.spread_db, least))
    blocks = len(np.unique(used.block))
    level = min(share * (1 + 1 / blocks), 1.0)  # conformal prediction's correction for so many blocks
    station = _of_stations(used, level)
    used = replace(used, spread_db=used.spread_db * station[used.station])
    count = int(np.clip(min(heard.sum() // ROWS_OF_A_BIN, blocks // BLOCKS_OF_A_BIN), 1, MOST_BINS))
    away = np.sort(used.distance[heard])
    # Rows of a raster share few distances: no bin is empty.
    first = sorted({float(part[0]) for part in np.array_split(away, count)} - {float(away[0])})
    count = len(first) + 1
    which = np.searchsorted(first, used.distance, side="right")
    bins = [used.subset(np.flatnonzero(which == number)) for number in range(count)]
    middle = np.array([float(np.median(one.distance)) for one in bins])
    spreads = [error_distribution(one) for one in bins]
    half = np.array([weighted_quantiles(np.abs(error), mass, level) for error, mass in spreads])
    rms = np.array([float(np.sqrt(mass @ error**2)) for error, mass in spreads])
    typical = np.array([float(np.median(one.spread_db)) for one in bins])
    weight = np.array([len(one) for one in bins], float)
    rising, order = IsotonicRegression().fit_transform, np.arange(count)
    half, rms = (rising(order, one * typical, sample_weight=weight) / typical for one in (half, rms))
    tail = None
    if heard.all():
        tail = np.quantile(used.error / np.interp(used.distance, middle, rms), TAIL)
    reach = float(np.quantile(used.distance, REACH))
    return IntervalScales(share, middle, half, rms, tail, reach, station, least)


def error_distribution(evidence: HeldOutLevels) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (m,) in deviations and their masses, those of censored rows spread over the errors they
    allow.

    The distribution of largest likelihood (B. W. Turnbull, J. Roy. Stat. Soc. B 38 (1976)); a row that allows
    no measured error counts as the least that its own can be in size.
    """
    bound, side = evidence.error, evidence.side.astype(np.int64)
    order = np.argsort(bound, kind="stable")
    bound, side = bound[order], side[order]
    heard = bound[side == 0]
    low, high = heard[[0, -1]] if len(heard) else (np.inf, -np.inf)
    alone = ((side > 0) & (bound < low)) | ((side < 0) & (bound > high))
    error = np.where(alone, side * np.minimum(side * bound, 0.0), bound)
    exact = np.sort(error[(side == 0) | alone])
    below = np.searchsorted(exact, bound[(side > 0) & ~alone], side="right")
    above = np.searchsorted(exact, bound[(side < 0) & ~alone], side="left")
    mass = np.full(len(exact), 1 / len(exact))
    for _ in range(COMPLETED if len(below) + len(above) else 0):
        total = np.r_[0.0, np.cumsum(mass)]
        share = np.zeros(len(exact) + 1)
        np.add.at(share, below, 1 / total[below])
        shared = np.cumsum(share[::-1])[::-1][1:]  # an error takes its part of all rows that allow it
        share[:] = 0.0
        np.add.at(share, above, 1 / (total[-1] - total[above]).clip(np.finfo(float).tiny))
        mass = (1 + mass * (shared + np.cumsum(share)[:-1])) / len(bound)
    return exact, mass


def weighted_quantiles(values: np.ndarray, mass: np.ndarray, share: float | np.ndarray) -> np.ndarray:
    """Return values, of (n,) with masses (n,), below which shares lie; of equal ones as `np.quantile`."""
    order = np.argsort(values, kind="stable")
    before = np.cumsum(mass[order]) - mass[order]
    return np.interp(share, before / max(float(before[-1]), 1e-300), values[order])


def _of_stations(used: HeldOutLevels, level: float) -> np.ndarray:
    """How much larger each station's errors are than all (T,); drawn towards 1 where blocks are few."""

    def typical(part: HeldOutLevels) -> float:
        error, mass = error_distribution(part)
        return float(weighted_quantiles(np.abs(error), mass, level))

    whole = typical(used)
    factors = np.ones(int(used.station.max()) + 1)
    for number in np.unique(used.station) if len(factors) > 1 and whole > 0 else ():
        own = used.subset(np.flatnonzero(used.station == number))
        if (own.side == 0).sum() >= LEAST_ROWS:
            blocks = len(np.unique(own.block))
            ratio = max(typical(own), 1e-3 * whole) / whole
            factors[number] = ratio ** (blocks / (blocks + ENOUGH_BLOCKS))
    return factors


def interval_coverage(calibration: IntervalScales, evidence: HeldOutLevels) -> tuple[np.ndarray, np.ndarray]:
    """Tell whether measured levels (n,) lie in their intervals; widths (n,) [dB], NaN out of reach."""
    half = calibration.half_and_error(evidence.spread_db, evidence.distance, evidence.station)[0]
    return np.abs(evidence.level_db - evidence.mean_db) <= half, 2 * half


@dataclass(frozen=True)
class Coverage:
    """How often a promise held on measured rows of blocks that its own calibration did not see.

    Rows beyond a level have none that an interval could hold.

    Attributes:
        share: of the rows in reach, that lay in their interval.
        width_db: mean width of intervals [dB].
        rows, blocks: tried.
    """

    share: float
    width_db: float
    rows: int
    blocks: int


def cross_validate(evidence: HeldOutLevels, share: float) -> Coverage:
    """Calibrate on some blocks, try on the others, by turns."""
    blocks, number = np.unique(evidence.block, return_inverse=True)
    part = np.random.default_rng(0).permutation(len(blocks))[number.reshape(-1)] % PARTS
    heard = evidence.side == 0
    inside, width = np.zeros(len(evidence), bool), np.full(len(evidence), np.nan)
    for turn in range(min(PARTS, len(blocks))):
        rest, tried = np.flatnonzero(part != turn), np.flatnonzero((part == turn) & heard)
        calibration = calibrate(evidence.subset(rest), share)
        inside[tried], width[tried] = interval_coverage(calibration, evidence.subset(tried))
    known = np.isfinite(width)
    return Coverage(float(inside[known].mean()), float(width[known].mean()), int(known.sum()), len(blocks))


def nearest_distances(
    known: np.ndarray, known_station: np.ndarray, places: np.ndarray, station: np.ndarray
) -> np.ndarray:
    """Return how far places (n, D) are from the nearest `known` one (m, D) of their station, else any [m]."""
    distance = np.full(len(places), np.inf)
    for number in np.unique(station):
        own = known[known_station == number]
        chosen = station == number
        distance[chosen] = cKDTree(own if len(own) else known).query(places[chosen])[0]
    return distance

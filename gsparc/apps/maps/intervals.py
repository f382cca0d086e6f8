"""Intervals that hold a measurement as often as they say,
learned from whole blocks of places held out.

The field alone, without the noise of a measurement, lies in them more often.
A prediction's own deviation is scaled by what it took to cover the errors of held-out rows as far
from data (split conformal prediction with a scale, J. Lei et al., J. Amer. Stat. Assoc. 113 (2018),
in bins of distance). Farther than any held-out row nothing is known, and nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.special import ndtr

from gsparc.prediction.left_out import HeldOutLevels
from gsparc.processes.uncertainty import (
    conformal_level,
    coverage_and_width,
    half_width,
    weighted_quantiles,
)

LEAST_ROWS = 40  # held out, for any promise
ROWS_OF_A_BIN, BLOCKS_OF_A_BIN = 150, 8
MOST_BINS = 8
PARTS = 5  # of blocks, that are calibrated without by turns
ENOUGH_BLOCKS = 10  # from which a station's own errors count more than those of all
REACH = 0.99  # quantile of the held-out rows' distances that is the farthest anything is said of
LEAST_SPREAD = 0.1  # of the median deviation: of a station with few rows some are next to 0
TAIL = np.concatenate([[0.001, 0.002, 0.005], np.linspace(0.01, 0.99, 99), [0.995, 0.998, 0.999]])


@dataclass(frozen=True)
class IntervalScales:
    """What scales a prediction's own deviation.

    Attributes:
        share: of measurements that intervals hold.
        distance: (K,) middles of bins [m].
        half: (K,) half of an interval, in deviations.
        rms: (K,) expected error, in deviations.
        tail: (Q,) quantiles `TAIL` of errors in expected errors; None where censored rows hide some
            of them.
        reach: beyond this distance nothing is said [m].
        station: (T,) what deviations of each are multiplied with before; of those not among them,
            1.
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
        scale = np.append(self.station, 1.0)[np.minimum(station, len(self.station))]
        scaled = np.where(distance <= self.reach, scale * np.maximum(spread_db, self.least), np.nan)
        half, rms = (
            scaled * np.interp(distance, self.distance, factor) for factor in (self.half, self.rms)
        )
        return half, rms

    def half_of(self, rows: HeldOutLevels) -> np.ndarray:
        """Return half the interval (n,) [dB] of rows, NaN out of reach."""
        return self.half_and_error(rows.spread_db, rows.distance, rows.station)[0]

    def probability_below(
        self, level_db: float | np.ndarray, mean_db: np.ndarray, expected_db: np.ndarray
    ) -> np.ndarray:
        """Return the probability (n,) that a measurement lies below a level;
        NaN where it is not known.
        """
        standard = (level_db - mean_db) / expected_db
        if self.tail is None:
            return ndtr(standard)
        # Beyond the rarest error that was seen it is rarer still, as of a normal one.
        tail_chance, normal = np.interp(standard, self.tail, TAIL), ndtr(standard)
        chance = np.where(standard > self.tail[-1], np.maximum(tail_chance, normal), tail_chance)
        chance = np.where(standard < self.tail[0], np.minimum(tail_chance, normal), chance)
        return np.where(np.isfinite(standard), chance, np.nan)


def calibrate(
    evidence: HeldOutLevels, share: float = 0.9, quarters: HeldOutLevels | None = None
) -> IntervalScales:
    """Learn the scales; their intervals get no narrower with distance.

    Args:
        evidence: of held-out rows.
        share: of measurements that intervals are to hold.
        quarters: rows of whole quarters held out, for places farther from rows than `evidence` has.

    Raises:
        ValueError: too few rows.
    """
    used = evidence.subset(np.isfinite(evidence.error))
    heard = used.heard
    if heard.sum() < LEAST_ROWS:
        fault = f"{heard.sum()} of them were held out, {LEAST_ROWS} at least are needed"
        raise ValueError(
            f"too few rows to test intervals ({fault}); promised=false draws without a promise"
        )
    least = LEAST_SPREAD * float(np.median(used.spread_db))
    used = replace(used, spread_db=np.maximum(used.spread_db, least))
    blocks = len(np.unique(used.block))
    level = conformal_level(share, blocks)
    station = _of_stations(used, level)
    used = replace(used, spread_db=used.spread_db * station[used.station])
    count = int(np.clip(min(heard.sum() // ROWS_OF_A_BIN, blocks // BLOCKS_OF_A_BIN), 1, MOST_BINS))
    bins, middle, typical = _by_distance(used, used.distance[heard], count)
    scales, weight = (
        np.array([_half_and_rms(part, level) for part in bins]).T,
        [len(part) for part in bins],
    )
    half, rms = (
        isotonic_regression(scale * typical, weights=weight).x / typical for scale in scales
    )
    scaled = used.error / np.interp(used.distance, middle, rms)
    tail = np.quantile(scaled, TAIL) if heard.all() else None
    reach = float(np.quantile(used.distance, REACH))
    near = IntervalScales(share, middle, half, rms, tail, reach, station, least)
    return near if quarters is None else _with_quarters(near, quarters)


def _with_quarters(near: IntervalScales, quarters: HeldOutLevels) -> IntervalScales:
    """Scales that go on where blocks end, by rows of quarters: as many of them tell, no more."""
    station = np.append(near.station, 1.0)[np.minimum(quarters.station, len(near.station))]
    far = replace(quarters, spread_db=np.maximum(quarters.spread_db, near.least) * station)
    far = far.subset((far.distance > near.reach) & np.isfinite(far.error))
    if far.heard.sum() < LEAST_ROWS:
        return near
    count = int(np.clip(len(far) // ROWS_OF_A_BIN, 1, MOST_BINS))
    bins, middle, typical = _by_distance(far, far.distance, count)
    rms = np.array([_half_and_rms(part, 0.5)[1] for part in bins]) * typical
    # No smaller than where blocks end, as everywhere else.
    least = near.rms[-1] * typical.min()
    rms = np.maximum(isotonic_regression(rms, weights=[len(part) for part in bins]).x, least)
    half = max(half_width(near.share, len(np.unique(far.block))), near.half[-1] / near.rms[-1])
    return replace(
        near,
        distance=np.append(near.distance, middle),
        rms=np.append(near.rms, rms / typical),
        half=np.append(near.half, half * rms / typical),
        reach=float(np.quantile(far.distance, REACH)),
    )


def _by_distance(
    rows: HeldOutLevels, distance: np.ndarray, count: int
) -> tuple[list[HeldOutLevels], np.ndarray, np.ndarray]:
    """Rows in at most so many bins of as many distances (m,) each, and their medians (K,) of
    distance [m] and deviation [dB].
    """
    # Rows of a raster share few distances: no bin is empty.
    first = np.unique([part[0] for part in np.array_split(np.sort(distance), count)])
    which = np.searchsorted(first[1:], rows.distance, side="right")
    bins = [rows.subset(which == number) for number in range(len(first))]
    medians = [(np.median(part.distance), np.median(part.spread_db)) for part in bins]
    return bins, *np.transpose(medians)


def _half_and_rms(part: HeldOutLevels, level: float) -> tuple[float, float]:
    """Which size a share `level` of errors is below, and their root mean square, in deviations."""
    error, mass = part.distribution()
    return float(weighted_quantiles(np.abs(error), mass, level)), float(np.sqrt(mass @ error**2))


def _of_stations(used: HeldOutLevels, level: float) -> np.ndarray:
    """How much larger each station's errors are than all (T,);
    drawn towards 1 where blocks are few.
    """
    whole, factors = _half_and_rms(used, level)[0], np.ones(int(used.station.max()) + 1)
    for number in np.unique(used.station) if len(factors) > 1 and whole > 0 else ():
        rows = used.subset(used.station == number)
        if rows.heard.sum() >= LEAST_ROWS:
            blocks = len(np.unique(rows.block))
            ratio = max(_half_and_rms(rows, level)[0] / whole, 1e-3)
            factors[number] = ratio ** (blocks / (blocks + ENOUGH_BLOCKS))
    return factors


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
    half = np.full(len(evidence), np.nan)
    for turn in range(min(PARTS, len(blocks))):
        in_test = (part == turn) & evidence.heard
        half[in_test] = calibrate(evidence.subset(part != turn), share).half_of(
            evidence.subset(in_test)
        )
    coverage, width = coverage_and_width(evidence.level_db - evidence.mean_db, half)
    return Coverage(coverage, width, int(np.isfinite(half).sum()), len(blocks))

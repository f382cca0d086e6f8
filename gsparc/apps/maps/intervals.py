"""Intervals that hold a measurement as often as they say, learned from whole blocks of places held out.

The field alone, without the noise of a measurement, lies in them more often.
A prediction's own deviation is scaled by what it took to cover the errors of held-out rows as far from data
(split conformal prediction with a scale, J. Lei et al., J. Amer. Stat. Assoc. 113 (2018), in bins of
distance). Farther than any held-out row nothing is known, and nothing is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

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
TAIL = np.concatenate([[0.001, 0.002, 0.005], np.linspace(0.01, 0.99, 99), [0.995, 0.998, 0.999]])


@dataclass(frozen=True)
class Evidence:
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

    def at(self, rows: np.ndarray) -> Evidence:
        """Some of them."""
        return Evidence(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def error(self) -> np.ndarray:
        """Measured less predicted (n,), in deviations; of censored rows the least it can be in size."""
        error = (self.level_db - self.mean_db) / self.spread_db
        return np.where(self.side != 0, self.side * np.minimum(self.side * error, 0.0), error)

    @property
    def informative(self) -> np.ndarray:
        """Rows (n,) bool that bound an error: measured, or predicted on the wrong side of their level."""
        return (self.side == 0) | (self.side * (self.level_db - self.mean_db) < 0)

    def state(self) -> dict[str, Any]:
        """For the `extra` of a checkpoint."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def restored(cls, state: Mapping[str, Any]) -> Evidence:
        """The inverse of `state`."""
        return cls(*(np.asarray(state[field.name]) for field in fields(cls)))


@dataclass(frozen=True)
class Calibration:
    """What scales a prediction's own deviation.

    Attributes:
        share: of measurements that intervals hold.
        distance: (K,) middles of bins [m].
        half: (K,) half of an interval, in deviations.
        rms: (K,) expected error, in deviations.
        tail: (Q,) quantiles `TAIL` of errors in expected errors; None where censored rows hide some of them.
        reach: beyond this distance nothing is said [m].
        station: (T,) what deviations of each are multiplied with before; of those not among them, 1.
    """

    share: float
    distance: np.ndarray
    half: np.ndarray
    rms: np.ndarray
    tail: np.ndarray | None
    reach: float
    station: np.ndarray

    def interval(self, spread_db: np.ndarray, distance: np.ndarray, station: np.ndarray) -> np.ndarray:
        """Half the interval (n,) [dB] at places of stations (n,); NaN out of reach."""
        return self._of(self.half, spread_db, distance, station)

    def expected_error(self, spread_db: np.ndarray, distance: np.ndarray, station: np.ndarray) -> np.ndarray:
        """Root mean square error (n,) [dB]; NaN out of reach."""
        return self._of(self.rms, spread_db, distance, station)

    def below(self, level_db: float, mean_db: np.ndarray, expected_db: np.ndarray) -> np.ndarray:
        """Probability (n,) that a measurement lies below a level; NaN where it is not known."""
        standard = (level_db - mean_db) / expected_db
        if self.tail is None:
            return norm.cdf(standard)
        chance = np.interp(standard, self.tail, TAIL)
        return np.where(np.isfinite(standard), chance, np.nan)

    def _of(
        self, factor: np.ndarray, spread_db: np.ndarray, distance: np.ndarray, station: np.ndarray
    ) -> np.ndarray:
        own = np.append(self.station, 1.0)[np.minimum(station, len(self.station))]
        scaled = own * spread_db * np.interp(distance, self.distance, factor)
        return np.where(distance <= self.reach, scaled, np.nan)


def calibrate(evidence: Evidence, share: float = 0.9) -> Calibration:
    """Learn the scales; their intervals get no narrower with distance.

    Args:
        evidence: of held-out rows.
        share: of measurements that intervals are to hold.

    Raises:
        ValueError: too few rows.
    """
    used = evidence.at(np.flatnonzero(evidence.informative & np.isfinite(evidence.error)))
    if len(used) < LEAST_ROWS:
        raise ValueError(
            f"{len(used)} held-out rows are too few for a promise; {LEAST_ROWS} at least are needed"
        )
    blocks = len(np.unique(used.block))
    level = min(share * (1 + 1 / blocks), 1.0)  # conformal prediction's correction for so many blocks
    station = _of_stations(used, level)
    used = replace(used, spread_db=used.spread_db * station[used.station])
    order = np.argsort(used.distance, kind="stable")
    count = int(np.clip(min(len(used) // ROWS_OF_A_BIN, blocks // BLOCKS_OF_A_BIN), 1, MOST_BINS))
    bins = [used.at(rows) for rows in np.array_split(order, count)]
    size = np.abs(used.error)
    middle = np.array([float(np.median(one.distance)) for one in bins])
    half = np.array([float(np.quantile(np.abs(one.error), level)) for one in bins])
    rms = np.array([float(np.sqrt(np.mean(one.error**2))) for one in bins])
    typical = np.array([float(np.median(one.spread_db)) for one in bins])
    weight = np.array([len(one) for one in bins], float)
    half, rms = (_rising(middle, one * typical, weight) / typical for one in (half, rms))
    tail = None
    if not evidence.side.any():
        standard = used.error / np.interp(used.distance, middle, rms)
        tail = np.quantile(standard, TAIL)
        tail = tail + np.arange(len(tail)) * 1e-9 * max(float(size.max()), 1.0)  # no two are equal
    return Calibration(share, middle, half, rms, tail, float(np.quantile(used.distance, REACH)), station)


def _of_stations(used: Evidence, level: float) -> np.ndarray:
    """How much larger each station's errors are than all (T,); drawn towards 1 where blocks are few."""
    size = np.abs(used.error)
    whole = float(np.quantile(size, level))
    factors = np.ones(int(used.station.max()) + 1)
    for number in np.unique(used.station) if len(factors) > 1 and whole > 0 else ():
        own = used.station == number
        if own.sum() >= LEAST_ROWS:
            blocks = len(np.unique(used.block[own]))
            ratio = max(float(np.quantile(size[own], level)), 1e-3 * whole) / whole
            factors[number] = ratio ** (blocks / (blocks + ENOUGH_BLOCKS))
    return factors


def _rising(distance: np.ndarray, width: np.ndarray, weight: np.ndarray) -> np.ndarray:
    if len(distance) == 1:
        return width
    return IsotonicRegression().fit_transform(np.arange(len(distance)), width, sample_weight=weight)


def covered(calibration: Calibration, evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n,) bool whose measurement lies in the interval, and widths (n,) [dB], NaN where nothing is said.

    A censored row is in an interval that reaches beyond its level.
    """
    half = calibration.interval(evidence.spread_db, evidence.distance, evidence.station)
    inside = np.abs(evidence.error * evidence.spread_db) <= half
    return inside & np.isfinite(half), 2 * half


@dataclass(frozen=True)
class Coverage:
    """How often a promise held on blocks that its own calibration did not see.

    Attributes:
        share: of the rows in reach, that lay in their interval.
        width_db: mean width of intervals [dB].
        reached: share of all rows that lay in reach.
        rows, blocks: tried.
        own_share, own_width_db: of the intervals that the model states by itself.
        heard_share, silent_share: of the rows with a level, and of those beyond one; NaN of none.
    """

    share: float
    width_db: float
    reached: float
    rows: int
    blocks: int
    own_share: float
    own_width_db: float
    heard_share: float
    silent_share: float


def cross_validated(evidence: Evidence, share: float) -> Coverage:
    """Calibrate on some blocks, try on the others, by turns."""
    blocks, number = np.unique(evidence.block, return_inverse=True)
    part = np.random.default_rng(0).permutation(len(blocks))[number.reshape(-1)] % PARTS
    inside, width = np.zeros(len(evidence), bool), np.full(len(evidence), np.nan)
    for turn in range(min(PARTS, len(blocks))):
        rest, tried = np.flatnonzero(part != turn), np.flatnonzero(part == turn)
        inside[tried], width[tried] = covered(calibrate(evidence.at(rest), share), evidence.at(tried))
    known = np.isfinite(width)
    half = float(norm.ppf((1 + share) / 2))
    own = np.abs(evidence.error) <= half
    return Coverage(
        float(inside[known].mean()), float(width[known].mean()), float(known.mean()), int(known.sum()),
        len(blocks), float(own[known].mean()), float(2 * half * evidence.spread_db[known].mean()),
        *(float(inside[part].mean()) if part.any() else np.nan
          for part in (known & (evidence.side == 0), known & (evidence.side != 0))),
    )  # fmt: skip


def distances(
    known: np.ndarray, known_station: np.ndarray, places: np.ndarray, station: np.ndarray
) -> np.ndarray:
    """From places (n, D) to the nearest of `known` (m, D) of their station, of any where it has none [m]."""
    distance = np.full(len(places), np.inf)
    for number in np.unique(station):
        own = known[known_station == number]
        chosen = station == number
        distance[chosen] = cKDTree(own if len(own) else known).query(places[chosen])[0]
    return distance

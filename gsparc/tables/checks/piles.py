"""Levels that pile up, which are none: marks, a floor, saturation. Levels are in dB or dBm, NaN for
no value.
"""

from __future__ import annotations

import numpy as np

from gsparc.data.blocks import rows_by

SATURATED = 0.01  # of all levels, at least
PILE = 0.05  # of all levels, at least: no level of a receiver holds as many by chance
APART_DB, GAP_DB = 20.0, 3.0  # between a mark and all levels; below a pile that holds many
REPEATS = 3  # of a mark
# Width of a pile of a receiver's noise; its share of the levels, at least
NOISE_DB, PILED = 4.0, 1 / 3


def find_floor_piles(station: np.ndarray, level_db: np.ndarray) -> dict[int, tuple[float, float]]:
    """Return `find_floor_pile` of stations (n,) whose levels (n,) [dB] have one,
    else that of all under -1.

    NaN are no levels.
    """
    station, level_db = station[finite := np.isfinite(level_db)], level_db[finite]
    heard = {t: level_db[rows] for t, rows in rows_by(station)}
    # Of a station that is seldom heard weak levels are missing, not piled up.
    often = max(map(len, heard.values()), default=0) / 2
    piles = {t: find_floor_pile(level) for t, level in heard.items() if len(level) >= often}
    piles |= {} if any(piles.values()) else {-1: find_floor_pile(level_db)}
    return {t: pile for t, pile in piles.items() if pile}


def find_floor_pile(levels: np.ndarray) -> tuple[float, float] | None:
    """Return the level below which a pile at the lowest of levels (n,) lies, and its share;
    None without.

    The lowest level may repeat. Else signals become rarer upwards no faster than exponentially
    (distances and shadowing have log-concave densities in decibels): a pile is one that far fewer
    follow than that law with the mean of all lets expect.
    """
    levels, (different, counts) = np.sort(levels), np.unique(levels, return_counts=True)
    if len(counts) < 4:
        return None
    if counts[0] > max(PILE * len(levels), 10, 5 * float(np.median(counts)), 3 * counts[1]):
        return float(different[1]), counts[0] / len(levels)
    window_counts = np.searchsorted(levels, levels + NOISE_DB, "right") - np.arange(len(levels))
    first, count = int(window_counts.argmax()), int(window_counts.max())
    top = levels[first] + NOISE_DB
    # A decibel above the pile
    after, end = np.searchsorted(levels, top + np.array([1, 1 + NOISE_DB]))
    low = first <= 0.1 * count + 2 and count >= max(PILED * len(levels), 15)
    # Few far above: the range of all is small
    if not low or len(levels) - end < PILE * len(levels):
        return None
    most = end - after + np.sqrt(end - after) + 1  # a deviation more than were counted
    expected = count * np.exp(-(NOISE_DB + 1) / (levels[first:] - levels[first]).mean())
    # In simulated tables without a floor more than .7 of those expected follow.
    return (float(top), (first + count) / len(levels)) if most < 0.7 * expected else None


def find_saturation(values: np.ndarray) -> float | None:
    """Return the highest of levels (n,) where it repeats as no level
    of a receiver does by chance.
    """
    different, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    piled = len(counts) > 1 and counts[-1] > max(SATURATED * counts.sum(), 10, 5 * counts[-2])
    return float(different[-1]) if piled else None


def find_sentinel_levels(values: np.ndarray) -> list[float]:
    """Return levels [dB] among (n,) that repeat exactly, apart from all others: marks, not levels.

    At either end more than 20 dB apart, and far beside the spread of the rest; at the upper end, as
    rows beside a station are strong, not below 0 or nearly as far as all others lie apart; at the
    lower end a pile needs only a gap, as a receiver's own levels have none.
    """
    marks: list[float] = []
    rest = values[np.isfinite(values)]
    while True:
        different, counts = np.unique(rest, return_counts=True)
        if len(different) < 4:
            return marks
        steps = np.diff(different)
        spans = (different[-1] - different[1], different[-2] - different[0])
        usual = max(GAP_DB, 5 * float(np.median(steps)))
        piled = counts[0] > max(PILE * len(rest), 10) and counts[0] > 5 * float(np.median(counts))
        piled = piled and steps[0] >= usual
        enough = (steps[[0, -1]] > np.maximum(APART_DB, 0.3 * np.array(spans))) & (
            counts[[0, -1]] >= REPEATS
        )
        beyond = different[-1] >= 0 or steps[-1] > max(1.5 * APART_DB, 0.7 * spans[1])
        new_marks = different[[0, -1]][enough & [True, beyond] | [piled, False]].tolist()
        if not new_marks:
            return marks
        marks += new_marks
        rest = rest[~np.isin(rest, new_marks)]

"""Steps in the level of a station over the rows: a gain was changed, a cable came loose,
another antenna.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gsparc.data.spacing import neighbour_distance
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.level_field import NUGGETS, fit_level_field

MOST_BLOCKS = 1000  # of rows; the cost is their cube: 0.3 s
LIKELIHOOD_BLOCKS = 300  # that choose the length of correlation
MOST_STEPS = 3
LEAST_ROWS = 60
SHORTEST = 1 / 20  # part of a station's rows between two steps
LEAST_DB = 10.0  # smaller ones are common between campaigns, and cost a model little
LEAST_SIGMAS = 6.0  # of the estimate; shadowing is not Gaussian, and every row is tried
FAR_M = 1e9  # between devices, which share no place
# Usual steps that rows of one place lie apart at most; of them before and after a step that tell
SAME_PLACE, LEAST_PAIRS = 3.0, 5


@dataclass(frozen=True)
class LevelStep:
    """A change of level between two rows.

    Attributes:
        last: the last row before it.
        first: the first row after it.
        change_db: level after minus level before, at equal places.
    """

    last: int
    first: int
    change_db: float


def detect_level_steps(
    position: np.ndarray,
    level_db: np.ndarray,
    station_position: np.ndarray | None = None,
    most_blocks: int = MOST_BLOCKS,
    device: np.ndarray | None = None,
) -> tuple[LevelStep, ...]:
    """Find where the level of one station changes though the places do not explain it.

    The level is a line in the logarithm of the distance, plus a field
    (`gsparc.processes.level_field`), plus a step at an unknown row. For every row the step's
    generalised least-squares estimate and its variance follow from two cumulative sums of the
    inverse covariance; the largest is kept, and the search repeated with it, like binary
    segmentation (Scott and Knott, Biometrics 30, 1974).
    Places seen before and after a step count most, as they should; one that the same device does
    not see there is no step.

    Args:
        position: (n, 2) or (n, 3) [m], in the order of measuring.
        level_db: (n,) [dB], NaN where there is none.
        station_position: (2,) or (3,) [m]; None: the level is not tied to a distance.
        most_blocks: rows are averaged to at most so many (median), against outliers and for speed.
        device: (n,) labels of what measured; None: one.
    """
    rows = np.flatnonzero(np.isfinite(level_db))
    if len(rows) < LEAST_ROWS or not np.ptp(position[rows], axis=0).any():
        return ()
    blocks = _blocks(rows, most_blocks)
    places = np.array([np.median(position[b], axis=0) for b in blocks])
    level = np.array([np.median(level_db[b]) for b in blocks])
    if not np.ptp(level):
        return ()
    mean: list[np.ndarray] = []
    if station_position is not None:
        distance = np.linalg.norm(places - np.asarray(station_position)[: places.shape[1]], axis=1)
        mean.append(np.log10(np.maximum(distance, np.ptp(places, axis=0).max() / 300)))
    some = evenly_spaced(len(level), LIKELIHOOD_BLOCKS)
    # Medians of rows hold less noise than rows do.
    of_some = places[some], level[some], np.zeros(len(some)), [column[some] for column in mean]
    field = fit_level_field(*of_some, nuggets=NUGGETS[:-1])
    precision, regressors = field.precision(places), np.column_stack([np.ones(len(level)), *mean])
    steps = [
        LevelStep(int(blocks[k - 1][-1]), int(blocks[k][0]), float(change))
        for k, change in zip(*_search(precision, level, regressors), strict=True)
        if abs(change) >= LEAST_DB
    ]
    steps.sort(key=lambda step: step.first)
    edges = [0, *(step.first for step in steps), len(position)]
    around = zip(steps, edges, edges[2:], strict=False)
    place = (
        position
        if device is None
        else np.c_[position, np.unique(device, return_inverse=True)[1] * FAR_M]
    )
    return tuple(
        step for step, start, end in around if _seen_again(place, level_db, rows, step, start, end)
    )


def _seen_again(
    place: np.ndarray, level_db: np.ndarray, rows: np.ndarray, step: LevelStep, start: int, end: int
) -> bool:
    """Whether rows at one place before and after a step, from `start` to `end`, differ by it."""
    before, after = (
        rows[(rows >= start) & (rows <= step.last)],
        rows[(rows >= step.first) & (rows < end)],
    )
    apart, nearest = cKDTree(place[before]).query(place[after])
    same = apart <= SAME_PLACE * neighbour_distance(place[rows])
    change = level_db[after] - level_db[before[nearest]]
    if same.sum() < LEAST_PAIRS:
        return False
    seen = float(np.median(change[same])) * np.sign(step.change_db)
    return seen >= LEAST_DB


def _blocks(rows: np.ndarray, most: int) -> list[np.ndarray]:
    """Consecutive rows in at most about `most` groups, none across a gap."""
    size = max(3, math.ceil(len(rows) / most))  # a median of three does not see a single wrong row
    pieces = np.split(rows, np.flatnonzero(np.diff(rows) > 10 * size) + 1)
    return [
        block for piece in pieces for block in np.array_split(piece, math.ceil(len(piece) / size))
    ]


def _search(
    precision: np.ndarray, level: np.ndarray, regressors: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """First blocks after steps of `LEAST_SIGMAS` and more,
    and estimates [dB] of all of them together.
    """
    count = len(level)
    margin = max(3, int(SHORTEST * count))
    after: list[int] = []
    for _ in range(MOST_STEPS):
        after.append(_best(precision, level, regressors, after, margin))
        # The first was found without the others
        for i in range(len(after)) if len(after) > 1 else ():
            others = after[:i] + after[i + 1 :]
            after[i] = _best(precision, level, regressors, others, margin)
    while True:
        design = np.column_stack([regressors, *(_step(count, k) for k in after)])
        covariance = np.linalg.pinv(design.T @ precision @ design)
        change = (covariance @ (design.T @ (precision @ level)))[regressors.shape[1] :]
        deviation = np.sqrt(np.diag(covariance)[regressors.shape[1] :].clip(1e-300))
        # A step that is none takes from its neighbours: without it the others are estimated again.
        sigmas = np.abs(change) / deviation
        if not after or sigmas.min() >= LEAST_SIGMAS:
            return after, change
        after.pop(int(sigmas.argmin()))


def _best(
    precision: np.ndarray, level: np.ndarray, mean: np.ndarray, steps: list[int], margin: int
) -> int:
    """The block after the most significant step, besides `steps`."""
    count = len(level)
    design = np.column_stack([mean, *(_step(count, k) for k in steps)])
    weighed = precision @ design
    projected = precision - weighed @ np.linalg.pinv(design.T @ weighed) @ weighed.T
    # For a step h_k = [row >= k]: h_k' P y and h_k' P h_k are sums over the rows from k on.
    slope = np.cumsum((projected @ level)[::-1])[::-1]
    weight = np.diag(np.cumsum(np.cumsum(projected[::-1, ::-1], axis=0), axis=1))[::-1]
    allowed = np.zeros(count, bool)
    allowed[margin : count - margin] = True
    for k in steps:
        allowed[max(0, k - margin) : k + margin] = False
    score = np.where(allowed & (weight > 1e-9), slope**2 / np.maximum(weight, 1e-9), -1.0)
    return int(np.argmax(score))


def _step(count: int, first: int) -> np.ndarray:
    return (np.arange(count) >= first).astype(np.float64)

"""Levels of links, and steps of a station's over the rows: a gain was changed, a cable came loose,
another antenna.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsparc.data.blocks import rows_by
from gsparc.data.schema import Measurements
from gsparc.data.spacing import neighbour_distance
from gsparc.physics.decibels import to_decibels
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.level_field import fit_level_field
from gsparc.tables.advice import MOST_ROWS, LevelsAtPlaces, is_better_parted

# Moves of which that share lead to a place nearer than all but a tenth of the others are an order;
# of a few places, to one of the nearest; changes of place that tell, and that are looked at
ORDERED, NEARER, NEAREST = 0.8, 0.1, 8
LEAST_PLACES, SAMPLE = 20, 500
UNNAMED = "the station"  # a single one, of a file without stations


@dataclass(frozen=True)
class LinkLevels:
    """One row for every measurement.

    Attributes:
        position: (n, 3) of the moving end, in the world [m].
        station: (n,) int64.
        level_db: (n,) [dB], NaN where there is no value.
        rows: (n,) what messages call the row of the file.
        file_row: (n,) its number from 0.
        names: (T,) of the stations, for people.
        keys: (T,) as settings take them.
        station_position: (T, 3), in the world [m]; NaN where it is not known.
        device: (n,) int64, what measured a row; None where nothing tells.
    """

    position: np.ndarray
    station: np.ndarray
    level_db: np.ndarray
    rows: list[str]
    file_row: np.ndarray
    names: list[str]
    keys: list[str]
    station_position: np.ndarray
    device: np.ndarray | None = None

    @cached_property
    def ordered(self) -> bool:
        """Whether rows are in an order of place: most moves lead to one of the places around.

        Where they do not, no question of the rows before and after means anything. A median step
        is no sign of it: one phone's rows may follow a way, and another's stand anyhow.
        """
        place = self.position[np.r_[True, (np.diff(self.position, axis=0) != 0).any(1)]]
        if len(place) < LEAST_PLACES:
            return True
        step = np.linalg.norm(np.diff(place, axis=0), axis=1)
        some, others = evenly_spaced(len(step), SAMPLE), evenly_spaced(len(place), SAMPLE)
        nearer = (cdist(place[some], place[others]) < step[some, None]).mean(1)
        return bool(np.quantile(nearer, ORDERED) <= max(NEARER, NEAREST / len(place)))

    def heard(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each station, and its rows (k,) with a value."""
        yield from (
            (t, rows[np.isfinite(self.level_db[rows])]) for t, rows in rows_by(self.station)
        )


def link_levels(data: Measurements, file_row: np.ndarray | None = None) -> LinkLevels | None:
    """Return levels of powers with one end that stands still; None of anything else.

    Args:
        data: the measurements.
        file_row: (S,) number of each row in its file; None: the row's own.
    """
    site = data.site
    if not site.maps_levels:
        return None
    stations = site.every_station
    with np.errstate(divide="ignore"):
        level = to_decibels(data.powers()[:, 0])
    rows = np.flatnonzero(data.censored_side() <= 0)
    of_file = [data.row_names[i].partition(", station")[0] for i in rows]
    names, keys = ([name or UNNAMED for name in names] for names in (stations.shown, stations.name))
    number = rows if file_row is None else file_row[rows]
    place, positions = data.moving[rows] + site.origin, stations.position + site.origin
    station, device = data.stations_of()[rows], None if data.device is None else data.device[rows]
    return LinkLevels(place, station, level[rows], of_file, number, names, keys, positions, device)


MOST, LEAST = 600, 200  # rows of a station, of many stations; the cost is their cube
MOST_STEPS = 3
AROUND = MOST_ROWS // 2  # rows before and after a step that it is tried on
LEAST_ROWS = 60
SHORTEST = 1 / 20  # part of a station's rows between two steps
LEAST_DB = 10.0  # smaller ones are common between campaigns, and cost a model little
# Usual steps that rows of one place lie apart at most; of them before and after a step that tell
SAME_PLACE, LEAST_PAIRS = 3.0, 5
FAR_M = 1e9  # between devices, which share no place
LEAST_SIGMAS = 6.0  # of the estimate; shadowing is not Gaussian, and every row is tried


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


def find_level_steps(levels: LinkLevels) -> list[tuple[int, LevelStep]]:
    """Return stations and their steps, which name rows of `levels`,
    where levels that are left out are predicted better with a station from the step on,
    and one device sees the step at the same places.
    """
    steps = list[tuple[int, LevelStep]]()
    most = int(np.clip(20 * MOST / max(len(levels.names), 1), LEAST, MOST))
    for t, used in levels.heard() if levels.ordered else ():
        position, level = levels.position[used], levels.level_db[used]
        candidates = detect_level_steps(position, level, levels.station_position[t], most)
        edges = [0, *(step.first for step in candidates), len(used)]
        for step, start, end in zip(candidates, edges, edges[2:], strict=False):
            near = np.arange(len(used))[max(step.first - AROUND, 0) : step.first + AROUND]
            links = LevelsAtPlaces(position[near], np.zeros(len(near), np.int64), level[near])
            device = None if levels.device is None else levels.device[used]
            again = _seen_again(position, level, device, step, slice(start, end))
            if again and is_better_parted(links, near >= step.first):
                named = replace(step, last=int(used[step.last]), first=int(used[step.first]))
                steps.append((t, named))
    return steps


def _seen_again(
    position: np.ndarray,
    level_db: np.ndarray,
    device: np.ndarray | None,
    step: LevelStep,
    part: slice,
) -> bool:
    """Whether rows `part` of one device at one place before and after a step differ by as much."""
    number = np.zeros(len(position)) if device is None else device
    place = np.c_[position, FAR_M * number]
    rows = np.arange(len(place))[part]
    before, after = rows[rows < step.first], rows[rows >= step.first]
    apart, nearest = cKDTree(place[before]).query(place[after])
    change = level_db[after] - level_db[before[nearest]]
    same = apart <= SAME_PLACE * neighbour_distance(place)
    seen = float(np.median(change[same])) if same.sum() >= LEAST_PAIRS else 0.0
    return bool(np.sign(step.change_db) * seen >= LEAST_DB / 2)


def step_warnings(levels: LinkLevels, steps: Sequence[tuple[int, LevelStep]]) -> list[str]:
    """Warn of stations whose level changes at a row, unexplained by places."""
    names, rows, warnings = levels.names, levels.rows, []
    for t in dict.fromkeys(t for t, _ in steps):
        who = f"station {names[t]}" if len(names) > 1 else "the level"
        station_steps = [step for station, step in steps if station == t]
        change = " and ".join(
            f"{'rises' if step.change_db > 0 else 'falls'} by {abs(step.change_db):.0f} dB between "
            f"{rows[step.last]} and {rows[step.first]}"
            for step in station_steps
        )
        first = ",".join(str(levels.file_row[step.first]) for step in station_steps)
        setting = (
            f"'dataset.level_steps={{{levels.keys[t]}:[{first}]}}' (rows from 0) makes it another"
        )
        setting = "" if names[t] == UNNAMED else f" {setting} station from there on"
        warnings.append(
            f"{who} {change}, which the places do not explain: another gain or antenna?{setting}"
        )
    return warnings


def detect_level_steps(
    position: np.ndarray,
    level_db: np.ndarray,
    station_position: np.ndarray | None = None,
    most: int = MOST,
) -> list[LevelStep]:
    """Find where the level of one station changes though the places do not explain it.

    The level is a line in the logarithm of the distance, plus a field
    (`gsparc.processes.level_field`), plus a step at an unknown row. For every row the step's
    generalised least-squares estimate and its variance follow from two cumulative sums of the
    inverse covariance; the largest is kept, and the search repeated with it, like binary
    segmentation (Scott and Knott, Biometrics 30, 1974).
    Places seen before and after a step count most, as they should.

    Args:
        position: (n, 2) or (n, 3) [m], in the order of measuring.
        level_db: (n,) [dB], NaN where there is none.
        station_position: (2,) or (3,) [m]; None, or NaN: the level is not tied to a distance.
        most: rows that are looked at.
    """
    rows = np.flatnonzero(np.isfinite(level_db))
    rows = rows[evenly_spaced(len(rows), most)]
    places, level, mean = position[rows], level_db[rows], list[np.ndarray]()
    if len(rows) < LEAST_ROWS or not np.ptp(places, axis=0).any() or not np.ptp(level):
        return []
    if station_position is not None and np.isfinite(station_position).all():
        distance = np.linalg.norm(places - np.asarray(station_position)[: places.shape[1]], axis=1)
        mean.append(np.log10(np.maximum(distance, np.ptp(places, axis=0).max() / 300)))
    field = fit_level_field(places, level, np.zeros(len(level)), mean)
    regressors = np.column_stack([np.ones(len(level)), *mean])
    after, change = _search(field.precision(places), level, regressors)
    return [
        LevelStep(int(rows[k - 1]), int(rows[k]), float(by))
        for k, by in sorted(zip(after, change, strict=True))
        if abs(by) >= LEAST_DB
    ]


def _search(
    precision: np.ndarray, level: np.ndarray, regressors: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """First rows after steps of `LEAST_SIGMAS` and more,
    and estimates [dB] of all of them together.
    """
    margin, after, change = max(3, int(SHORTEST * len(level))), list[int](), np.zeros(0)
    for _ in range(MOST_STEPS):
        longer = [*after, _best(precision, level, regressors, after, margin)]
        design = np.column_stack([regressors, *(_step(len(level), k) for k in longer)])
        covariance = np.linalg.pinv(design.T @ precision @ design)
        estimate = covariance @ (design.T @ (precision @ level))
        deviation = np.sqrt(np.diag(covariance).clip(1e-300))
        if abs(estimate[-1]) < LEAST_SIGMAS * deviation[-1]:
            break
        after, change = longer, estimate[regressors.shape[1] :]
    return after, change


def _best(
    precision: np.ndarray, level: np.ndarray, mean: np.ndarray, steps: list[int], margin: int
) -> int:
    """The row after the most significant step, besides `steps`."""
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

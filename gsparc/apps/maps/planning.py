"""Where to measure next: the places that together take most off the expected error over an area.

Greedy choice of the largest drop of the mean posterior variance (A-optimal design; A. Krause, A.
Singh and C. Guestrin, J. Mach. Learn. Res. 9 (2008), choose greedily by information instead).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from gsparc.apps.maps.area import FloorPlan, Grid, lay_grid
from gsparc.apps.maps.covariance import ErrorCovariance, error_covariances, prior_covariances
from gsparc.apps.maps.geojson import read_shapes
from gsparc.apps.maps.making import MOST_DB, choose_stations
from gsparc.apps.maps.promise import Promise
from gsparc.apps.maps.streets import StreetGraph, Tour, Ways
from gsparc.base.errors import DataError
from gsparc.base.limits import POSITIVE, check_arguments, choice, number, or_null, whole
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import read_place

# Covariances are over all places: 900 targets and 900 candidates are 26 MB in float64.
TARGETS = 900  # places that the error is averaged over, about
CANDIDATES = 900  # where somebody may measure, at most
# Share of the expected error over an area, that places must take away to be worth their walk
WORTH = 0.02


@dataclass(frozen=True)
class MeasurementPlan:
    """Places to measure, the most telling first, or in the order of a walk; errors are of the goal.

    Attributes:
        places: (n, 3) world [m].
        expected_db: (n,) expected error over the area once this place and those chosen before it
            are measured [dB].
        before_db: the same before any of them is.
        chosen: (n,) int64, which the greedy choice took first, 0 to n - 1.
        length_m: of the shortest walk through them that was found [m].
        grid: the area.
        error_before, error_after: (S,) expected error at `at` [dB].
        at: (S, 3) places that errors were averaged over [m].
        scatter_db: of these errors, that of a single measurement, which no other place takes away
            [dB].
        metres: (n,) walked at each place [m]; (0,) where the order is that of gains.
        path: (m, 2) corners of the walk [m], along the lines of `walkable`; (0, 2) likewise.
        stopped: why there are fewer than were asked for; "" where there are not.
    """

    places: np.ndarray
    expected_db: np.ndarray
    before_db: float
    chosen: np.ndarray
    length_m: float
    grid: Grid
    error_before: np.ndarray
    error_after: np.ndarray
    at: np.ndarray
    scatter_db: float
    metres: np.ndarray
    path: np.ndarray
    stopped: str = ""

    @property
    def after_db(self) -> float:
        """Expected error once all are measured [dB]."""
        return float(self.expected_db[self.chosen.argmax()]) if len(self.places) else self.before_db

    @property
    def in_vain(self) -> str:
        """Why these places are hardly worth measuring; "" where they are."""
        gain = self.before_db - self.after_db
        if not len(self.places) or gain >= WORTH * self.before_db:
            return ""
        return (
            f"hardly worth measuring: {len(self.places)} places (a walk of {self.length_m:.0f} "
            "m) lower the "
            f"expected error of {self.before_db:.2f} dB by {gain:.2g} dB; {self.scatter_db:.2f} "
            "dB of it are "
            "scatter of single measurements; set area= to where less was measured"
        )


def plan_measurements(
    predictor: Predictor | None,
    count: int = 20,
    area: Any = None,
    *,
    height_m: float | None = None,
    walkable: Any = None,
    plan: FloorPlan | None = None,
    stations: Sequence[str | int] | None = None,
    other_end: Sequence[float] | None = None,
    promise: Promise | None = None,
    least_gain_db: float = 0.0,
    route: bool = True,
    start: Sequence[float] | None = None,
    route_m: float | None = None,
    length_m: float | None = None,
    goal: str = "strongest",
    threshold_db: float | None = None,
) -> MeasurementPlan:
    """Choose places to measure next, as a batch.

    >>> plan = gsparc.apps.maps.plan_measurements(gsparc.load("model.ckpt"), count=20, route=True)
    >>> plan.places.shape, plan.after_db < plan.before_db
    ((20, 3), True)

    Args:
        predictor: of powers; None before anything is measured, with `area` or `plan`.
        count: places wanted.
        area, height_m, plan: see `lay_grid`; with a promise and neither area nor plan, what it
            answers for.
        walkable: GeoJSON file of where somebody may measure: polygons, or lines such as streets,
            along which the walk then goes; None: the whole area.
        stations, other_end: see `predict_map`; whose error is to fall.
        promise: evidence of held-out blocks, which scales the model's own variances, and tells how
            many stations a place lists, those that are predicted strongest there; None: a place
            measures all.
        least_gain_db: stop where a place takes less than this off the expected error.
        route: whether places are put in the order of a short walk, or drive; else the most telling
            first.
        start: (2,) where the walk starts [m]; None: anywhere.
        route_m: longest walk [m]; None: any.
        length_m: before anything is measured, over which powers are alike [m].
        goal, threshold_db: what shall be known, see `weigh_goal`.

    Raises:
        DataError: anything wrong with what is asked for.
    """
    metres = {"route_m": or_null(POSITIVE), "length_m": or_null(POSITIVE)}
    metres |= {
        "goal": choice("strongest", "all"),
        "threshold_db": or_null(number(-MOST_DB, MOST_DB)),
    }
    check_arguments(locals(), count=whole(1), least_gain_db=number(0), **metres)
    grid = coarse_grid(predictor, area, height_m, plan, promise)
    targets, streets = grid.places(), None
    places, first = targets, 0  # candidates are the places from `first` on
    if walkable is not None:
        allowed, streets = walkable_places(walkable, grid)
        places, first = np.concatenate([targets, allowed]), len(targets)
    # Before anything is measured only the distance over which powers are alike is known.
    if predictor is None:
        covariances = prior_covariances(places, length_m)
    else:
        names, _ = choose_stations(predictor, stations)
        covariances = error_covariances(
            predictor, places, names, promise, other_end, goal, threshold_db
        )
    begin = np.zeros((0, 2)) if start is None else read_place("start", start, 2)[None, :2]
    ways = Ways.between(np.concatenate([places[first:, :2], begin]), streets)
    tour = Tour(ways.length, len(places) - first if len(begin) else None, route_m)
    wanted = np.arange(len(places)) < len(targets)
    before = root_mean_variance(covariances)
    before_db = float(np.sqrt(np.mean(before[wanted] ** 2)))
    too_near = pairs_too_near(places[first:, :2], count)
    chosen, expected, stopped = choose_greedily(
        covariances, first, wanted, count, least_gain_db, tour, before_db, too_near
    )
    order = np.array(
        [chosen.index(cell) for cell in (tour.walk[1:-1] if route else chosen)], np.int64
    )
    path = ways.path_through(tour.walk[0 if len(begin) else 1 : -1]) if route else np.zeros((0, 2))
    scatter = float(
        np.sqrt(
            np.mean(
                [covariance.noise * covariance.weight[wanted].mean() for covariance in covariances]
            )
        )
    )
    return MeasurementPlan(
        places[first:][np.array(chosen, np.int64)[order]],
        np.array(expected)[order],
        before_db,
        order,
        float(tour.metres[-1:].sum()),
        grid,
        before[wanted],
        root_mean_variance(covariances)[wanted],
        places[wanted],
        scatter,
        tour.metres if route else np.zeros(0),
        path,
        stopped,
    )


def coarse_grid(
    predictor: Predictor | None,
    area: Any,
    height_m: float | None,
    plan: FloorPlan | None = None,
    promise: Promise | None = None,
    count: int = TARGETS,
) -> Grid:
    """Return about `count` cells; where nobody says which, those that a promise reaches."""
    fine = lay_grid(None if predictor is None else predictor.site, area, height_m, None, plan)
    if area is None and plan is None and promise is not None and predictor is not None:
        local = fine.places(np.arange(fine.inside.size)) - predictor.site.origin
        # No farther than a promise reaches: where nothing is said, measuring cannot be weighed.
        told = promise.within_reach(local).reshape(fine.inside.shape)
        fine = replace(fine, inside=fine.inside & told)
    west, east, south, north = fine.extent
    share = fine.inside.mean()
    step = float(np.sqrt((east - west) * (north - south) * share / count))
    x, y = (np.arange(a + step / 2, b, step) for a, b in ((west, east), (south, north)))
    column, row = (
        ((v - a) / fine.step).astype(int).clip(0, n - 1)
        for v, a, n in ((x, west, len(fine.x)), (y, south, len(fine.y)))
    )
    inside = fine.inside[np.ix_(row, column)]
    if not inside.any():
        return fine
    return replace(fine, x=x, y=y, step=step, inside=inside)


def walkable_places(
    path: Any, grid: Grid, key: str = "walkable"
) -> tuple[np.ndarray, StreetGraph | None]:
    """Return places (n, 3) in polygons or along lines of a file, and these lines; None:
    it holds none.
    """
    west, east, south, north = grid.extent
    area, lines = read_shapes(path, key, grid.origin, True, max(east - west, north - south))
    from shapely import contains_xy

    points, streets = [np.zeros((0, 2))], None
    if not area.is_empty:
        low, high = np.reshape(area.bounds, (2, 2))
        # Four times too many, since bounds of a corridor's polygon are mostly empty.
        step = max(grid.step / 2, float(np.sqrt((high - low).prod() / (4 * CANDIDATES))))
        x, y = (np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True))
        lattice = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        points.append(lattice[contains_xy(area, lattice)])
    if lines:
        streets = StreetGraph.from_lines(lines, grid.step / 2)
        # One of each step's square: a street with many bends has no more of them.
        square = np.unique((streets.node / grid.step * 2).round(), axis=0, return_index=True)[1]
        points.append(streets.node[square])
    places = np.concatenate(points)
    if not len(places):
        raise DataError(f"{key}={path}: its polygons are too small for any place")
    if len(places) > CANDIDATES:
        # A fixed seed: the same file gives the same candidates.
        places = places[np.random.default_rng(0).permutation(len(places))[:CANDIDATES]]
    return np.column_stack([places, np.full(len(places), grid.height)]), streets


def choose_greedily(
    covariances: list[ErrorCovariance],
    first: int,
    wanted: np.ndarray,
    count: int,
    least_gain_db: float,
    tour: Tour,
    error: float,
    too_near: np.ndarray,
) -> tuple[list[int], list[float], str]:
    """Return chosen candidates, expected error after each, and why it stopped early.

    Candidates are the places from `first` on, by whose numbers they are in `tour`;
    `error` is that before. Of two that are `too_near` (C, C) one alone is chosen, while others are
    left.
    """
    free = np.ones(len(wanted) - first, bool)
    chosen: list[int] = []
    expected: list[float] = []
    while len(chosen) < count:
        # Sums of variances taken away over stations: one walk measures all of them.
        gains = np.sum(
            [covariance.variance_reductions(wanted)[first:] for covariance in covariances], axis=0
        )
        possible = free & tour.reachable()[: len(free)]
        apart = possible & ~too_near[chosen].any(axis=0)
        possible = apart if apart.any() else possible
        if not possible.any():
            why = "no place is left" if not free.any() else "no other place fits in the walk"
            return chosen, expected, f"{why} after {len(chosen)} places"
        best = int(np.where(possible, gains, -np.inf).argmax())
        # Mean square errors subtract, roots do not.
        error_after = float(
            np.sqrt(max(error**2 - gains[best] / (len(covariances) * wanted.sum()), 0))
        )
        if (gain := error - error_after) < least_gain_db:
            return (
                chosen,
                expected,
                (f"the next place gains {gain:.2g} dB, less than {least_gain_db:g} dB"),
            )
        for covariance in covariances:
            covariance.condition_on(first + best)
        error = error_after
        chosen.append(best)
        expected.append(error)
        tour.add(best)
        free[best] = False
    return chosen, expected, ""


def pairs_too_near(places: np.ndarray, count: int) -> np.ndarray:
    """Return which of places (C, 2) are too near to be measured both, (C, C) bool: nearer than half
    of what as many places, evenly spread, are apart.
    """
    distance, far = cdist(places, places), np.full(len(places), np.inf)
    # The farthest from all before, again and again: as even as a design gets.
    number = 0
    for _ in range(max(min(count, len(places)) - 1, 1)):
        far = np.minimum(far, distance[number])
        number = int(far.argmax())
    return distance < far.max() / 2


def root_mean_variance(covariances: list[ErrorCovariance]) -> np.ndarray:
    """Return the root of the mean variance over stations at each place (S,) [dB]."""
    return np.sqrt(np.mean([covariance.variances() for covariance in covariances], axis=0))

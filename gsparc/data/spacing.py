"""How far places lie apart: usual steps, visits of one place, squares of floor,
paths of measuring.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsparc.processes.few_rows import evenly_spaced

# Rows form a path while their median step is below this many nearest-neighbour distances.
PATH_STEP_RATIO = 4.0
NEAR = 0.01  # of the usual step: places nearer than this are visits of one
ONE_PLACE_M = 1e-6  # side of squares where all places are one
FEWEST_PLACES, SAMPLE = 10, 10_000  # that tell a usual step; more tell nothing more
# Large odd factors: cells become numbers, which sort much faster than rows.
_ODD = [0x1E3779B97F4A7C15, 0x2545F4914F6CDD1D, 0x3C6EF372FE94F82B, 7919, 104729**3, 3**38]
MIXING = 2**62 + np.array(_ODD)
EDGE = 1e-6  # of a square: places on its edge are in it, however they were rounded


def neighbour_distance(places: np.ndarray) -> float:
    """Return the median distance [m] from places (n, D) to the nearest other, copies left out;
    0 of one.

    >>> neighbour_distance(np.array([[0.0, 0], [0, 0], [0, 2], [0, 4]]))
    2.0
    """
    places = np.unique(places, axis=0)
    return float(np.median(cKDTree(places).query(places, k=2)[0][:, 1])) if len(places) > 1 else 0.0


def usual_step(positions: np.ndarray) -> float:
    """Return the median distance [m] from a place (n, D) to the nearest other;
    0 where too few tell it.

    Looked for from coarse to fine, as all places may have been visited again: what lies in a cell
    is one, and the first step that is ten cells long stands.

    >>> round(usual_step(np.c_[np.arange(20.0), np.zeros(20)]), 3)  # along a line, every metre
    1.0
    """
    side = extent = float(np.ptp(positions, axis=0).max())
    while side > 1e-12 * extent:
        # Cells of the current side first, so that visits of one place do not make its step zero.
        places, step = (
            positions[np.unique(_joined(positions, side, side / 2), return_index=True)[1]],
            0.0,
        )
        if len(places) >= FEWEST_PLACES:
            some = places[evenly_spaced(len(places), SAMPLE)]
            step = float(np.median(cKDTree(places).query(some, k=2)[0][:, 1]))
        if step >= 10 * side:
            return step
        side = min(step or side, side) / 10
    return 0.0


def group_visits(positions: np.ndarray, place: np.ndarray | None = None) -> np.ndarray | None:
    """Return the place (S,) int64 of each row where those nearer
    than `NEAR` usual steps count as one.

    >>> line = np.c_[np.arange(20.0), np.zeros(20)]  # every metre, and once more 1 mm beside it
    >>> group_visits(np.r_[line, line + 1e-3])[[0, 1, 20, 21]].tolist()
    [0, 1, 0, 1]

    Args:
        positions: (S, D) [m].
        place: (S,) of rows known to be of one place; returned as it is where no others are.
    """
    first = which = np.arange(len(positions))
    if place is not None:
        _, first, which = np.unique(place, return_index=True, return_inverse=True)
    places = positions[first]
    reach = NEAR * usual_step(places)
    if reach == 0:
        return place
    # A cell's diagonal is a quarter of `reach`: two representatives are at most 1.5 of it apart.
    # All nearer than `reach`
    joined = _joined(places, reach / 4 / np.sqrt(places.shape[1]), 1.5 * reach)
    return (
        place
        if len(np.unique(joined)) == len(places)
        else number_places(joined[which.reshape(-1), None])
    )


def _joined(places: np.ndarray, cell: float, reach: float) -> np.ndarray:
    """A number (n,) that places (n, D) share in a cell,
    or where one of each cell is within `reach` [m].

    Cells first: thousands of visits of one place would be millions of pairs.
    """
    corner = np.floor((places - places.min(axis=0)) / cell).astype(np.int64)
    # The sums wrap around on overflow, as a hash does: two cells hardly ever share a number.
    _, first, which = np.unique(
        corner @ MIXING[: corner.shape[1]], return_index=True, return_inverse=True
    )
    start, end = cKDTree(places[first]).query_pairs(reach, output_type="ndarray").T
    graph = coo_array((np.ones(len(start)), (start, end)), (len(first), len(first)))
    return np.asarray(connected_components(graph)[1][which.reshape(-1)])


def tenth_of_extent(floor: np.ndarray) -> float:
    """Return the side [m] of squares of which ten hold the longer side of places (n, 2)."""
    return float(np.ptp(floor, axis=0).max()) / 10 * (1 + 2 * EDGE)


def number_squares(floor: np.ndarray, side: float) -> np.ndarray:
    """Return the number (n,) of the square of `side` [m] that each place (n, 2) is in, from zero.

    >>> number_squares(np.array([[0.5, 0.5], [0.9, 0.1], [3.5, 0.5]]), side=1.0)
    array([0, 0, 1])
    """
    # Counted from zero, which `split_for` puts at the lowest place of the whole campaign.
    return np.unique(np.floor(floor / side + EDGE), axis=0, return_inverse=True)[1].reshape(-1)


def squares_of_extent(floor: np.ndarray, across: int = 10) -> np.ndarray:
    """Return the number (n,) of the square that each place (n, 2) [m] is in, of which `across` hold
    the longer side.

    >>> squares_of_extent(np.array([[0.0, 0.0], [0.5, 0.0], [9.9, 0.0]]))
    array([0, 0, 1])
    """
    side = max(tenth_of_extent(floor), ONE_PLACE_M) * 10 / across
    return number_squares(floor - floor.min(0), side)


def path_order(positions: np.ndarray) -> np.ndarray:
    """Return the rows (S,) in the order of the measuring path.

    Rows taken one after the other keep their order. Where consecutive rows are far apart compared
    with nearest neighbours (a shuffled file, random drops) there is no path: rows are ordered along
    the longest side of the box, so that a stretch becomes a slab.

    No path: along x:

    >>> path_order(np.array([[0.0, 0, 0], [9, 0, 0], [1, 0, 0], [8, 0, 0], [2, 0, 0]]))
    array([0, 2, 4, 3, 1])
    """
    rows = np.arange(len(positions))
    if len(positions) < 3:
        return rows
    step = np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    nearest = np.median(cKDTree(positions).query(positions, k=2)[0][:, 1])
    if step <= PATH_STEP_RATIO * nearest:
        return rows
    # Stable, so that places with equal coordinates stay in the order of the file.
    longest = int(np.argmax(np.ptp(positions, axis=0)))
    return np.argsort(positions[:, longest], kind="stable")


def rows_far_from(
    positions: np.ndarray, rows: np.ndarray, others: np.ndarray, distance: float
) -> np.ndarray:
    """Return those `rows` that are more than `distance` [m] away from all `others` (rows).

    >>> line = np.arange(5.0)[:, None]
    >>> rows_far_from(line, np.array([0, 1, 2]), np.array([4]), distance=2.5)
    array([0, 1])
    """
    return rows[cKDTree(positions[others]).query(positions[rows])[0] > distance]


def thin_rows(
    positions: np.ndarray, rows: np.ndarray, distance: float, seed: list[int] | np.random.Generator
) -> np.ndarray:
    """Return a largest-as-drawn subset of `rows`, sorted,
    in which no two are closer than `distance` [m].

    >>> line = np.arange(9.0)[:, None]
    >>> rows = thin_rows(line, np.arange(9), distance=2.0, seed=[0])
    >>> bool(np.diff(rows).min() > 2)
    True
    """
    tree, free = cKDTree(positions[rows]), np.ones(len(rows), dtype=bool)
    subset = []
    for i in np.random.default_rng(seed).permutation(len(rows)):
        if free[i]:
            subset.append(i)
            free[tree.query_ball_point(positions[rows[i]], distance)] = False
    return rows[np.sort(subset)]


def number_places(places: np.ndarray) -> np.ndarray:
    """Number each of `places` (n, 3), (n,) int64, in the order in which they first appear."""
    _, first, which = np.unique(places, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[which.reshape(-1)]

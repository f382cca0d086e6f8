"""Receivers over an area, on a grid, along streets, or out of a file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.errors import DataError
from gsparc.simulate.scenes.settings import Layout, SceneSettings
from gsparc.simulate.scenes.solid import Solid
from gsparc.tables.query_places import read_query_places, read_times

if TYPE_CHECKING:
    from gsparc.simulate.scenes.osm import Town

log = logging.getLogger(__name__)

MOST = 1_000_000  # places


@dataclass(frozen=True)
class Ground:
    """What receivers stand on, and where they may.

    Attributes:
        allowed: which of places (n, 3) [m], world, are not in, on or above what stands there (n,)
            bool.
        lift: turns heights above ground (or roof) of places (n, 3) into world z [m].
        open_sky: whether nothing is above those that are allowed.
    """

    allowed: Callable[[np.ndarray], np.ndarray]
    lift: Callable[[np.ndarray], np.ndarray] = lambda points: points
    open_sky: bool = False


class Placed(NamedTuple):
    """Receivers (R, 3) float64 [m], world, and when (R,) each was there [s];
    None where that says nothing.
    """

    places: np.ndarray
    time_s: np.ndarray | None = None

    def subset(self, free: np.ndarray) -> Placed:
        """Return the receivers where `free` (R,) is True."""
        return Placed(self.places[free], None if self.time_s is None else self.time_s[free])


def place_receivers(
    scene: SceneSettings, area: np.ndarray, ground: Ground, town: Town | None = None
) -> Placed:
    """Return places of the scene's layout that stand nowhere else than on the ground.

    Args:
        scene: says how many and how high they are, which is drawn for each but out of a file.
        area: (2, 2) [m] lower and upper corner in x and y.
        ground, town: of the scene.

    Raises:
        ValueError: no places, or places inside of something where that is refused.
    """
    how, height, seed = scene.layout, scene.height_m, scene.seed
    if how.kind == "area":

        def allowed(points: np.ndarray) -> np.ndarray:
            return ground.allowed(ground.lift(points))

        # Drawn with heights above the ground, tested and returned in the world.
        return Placed(
            ground.lift(sample_positions(scene.num_receivers, area, height, allowed, seed))
        )
    if how.kind == "file":
        flat, time_s = _of_file(how, town, float(np.mean(height)))
        names = [f"row {i}" for i in range(len(flat))]
    else:
        across, time_s = _along(how, area, () if town is None else town.streets), None
        if not 0 < len(across) <= MOST:
            raise ValueError(f"scene.receivers: {len(across)} places; expected 1 to {MOST:,}")
        heights = np.random.default_rng(seed).uniform(min(height), max(height), len(across))
        flat = np.column_stack([across, heights])
        names = [f"({x:.1f}, {y:.1f})" for x, y in across]
    points = ground.lift(flat)
    free = ground.allowed(points)
    if not free.all():
        first, number = names[int(np.argmin(free))], int((~free).sum())
        inside = f"{number} of {len(free)} receivers stand in or on something, the first at {first}"
        if how.inside == "refuse" or (how.inside is None and how.kind == "file"):
            raise ValueError(
                f"scene.receivers: {inside}; scene.receivers.inside=drop leaves them out, "
                "scene.over=roofs means heights above roofs"
            )
        log.warning("%s: left out", inside)
    if free.sum() < 2:
        raise ValueError(
            "scene.receivers: fewer than two places are free; is the area inside a building?"
        )
    return Placed(points, time_s).subset(free)


def _along(how: Layout, area: np.ndarray, streets: Sequence[np.ndarray]) -> np.ndarray:
    """Places (n, 2) [m] of a grid or along streets."""
    if how.kind == "grid":
        low, high = area
        # One more than there are spacings: both ends of a side count.
        counts = np.floor((high - low) / how.spacing_m).astype(int) + 1
        if counts.prod() > MOST:
            raise ValueError(
                f"scene.receivers.spacing_m={how.spacing_m:g}: {counts.prod():,} places"
            )
        axes = [np.arange(n) * how.spacing_m + start for n, start in zip(counts, low, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    if not streets:
        raise ValueError(
            "scene.receivers.kind=streets: this scene has no streets; use grid or file"
        )
    walked = np.concatenate([_steps(line, how.spacing_m) for line in streets])
    return walked[((walked >= area[0]) & (walked <= area[1])).all(1)]


def _steps(line: np.ndarray, spacing: float) -> np.ndarray:
    """Places (n, 2) every `spacing` [m] along a line (c, 2), from its start."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    if along[-1] / spacing > MOST:
        raise ValueError(f"scene.receivers: over {MOST:,} places along {along[-1]:.3g} m")
    # The end of the line counts, however its length was rounded.
    steps = np.arange(0.0, along[-1] + 1e-9, spacing)
    return np.column_stack([np.interp(steps, along, line[:, i]) for i in range(2)])


def _of_file(how: Layout, town: Town | None, height: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Places (n, 3) and times (n,) of a file;
    heights that it does not give are the middle of the scene's.
    """
    if how.file is None:
        raise ValueError(
            "scene.receivers.file is missing; expected a table with x and y, or degrees"
        )
    try:
        table, time_s = read_query_places(how.file, ["rx"]), read_times(how.file)
    except DataError as error:
        raise ValueError(f"scene.receivers.file: {error}") from None
    for note in table.notes:
        log.info("%s: %s", how.file, note)
    listed = table.ends["rx"]
    across = listed.across
    if listed.degrees:
        if town is None:
            raise ValueError(
                f"{how.file}: degrees, but this scene is nowhere on Earth; expected x and y"
            )
        across = town.georeference.from_degrees(*across.T)
    above = np.full(len(across), height) if listed.height is None else listed.height
    return np.column_stack([across, above]), time_s


TRIES = 200  # draws for each place, of which one is to be allowed
DRAWN = 1024  # at a time


def sample_positions(
    count: int,
    area: np.ndarray,
    height: Sequence[float],
    allowed: Callable[[np.ndarray], np.ndarray],
    seed: int,
) -> np.ndarray:
    """Draw `count` positions (S, 3) float64 [m], uniform over an area where `allowed` is True.

    A larger count begins with the positions of a smaller one.

    >>> area = np.array([[0.0, 0.0], [9.0, 9.0]])
    >>> sample_positions(5, area, (1.2, 1.8), lambda points: points[:, 0] > 3, seed=0).shape
    (5, 3)

    Args:
        area: (2, 2) [m] lower and upper corner in x and y.
        height: lowest and highest z [m].
        allowed: (N, 3) -> (N,) bool.

    Raises:
        ValueError: almost nowhere is allowed.
    """
    low, high = (np.array([*area[i], end(height)], dtype=float) for i, end in enumerate((min, max)))
    if not (np.isfinite([low, high]).all() and (high >= low).all() and (high > low)[:2].all()):
        raise ValueError(
            f"scene.area_m, scene.height_m: expected lower below upper, got {low} and {high}"
        )
    rng = np.random.default_rng(seed)
    places = np.empty((0, 3))
    for _ in range(TRIES * -(-count // DRAWN)):
        # Always as many at a time: what is drawn does not depend on the count.
        sample = rng.uniform(low, high, size=(DRAWN, 3))
        places = np.concatenate([places, sample[allowed(sample)]])
        if len(places) >= count:
            return places[:count]
    fit = f"only {len(places)} of {count} receivers fit into scene.area_m"
    raise ValueError(f"scene: {fit}; is that area inside a building?")


def make_clearance_test(
    solids: Sequence[Solid], margin: float = 0.05
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a test: which places (n, 3) [m] stand `margin` [m] away from boxes and off sheets."""
    boxes = np.array([s.keep_out for s in solids if s.keep_out is not None]).reshape(-1, 2, 3)
    walls = [s.vertices for s in solids if s.keep_out is None]

    def allowed(points: np.ndarray) -> np.ndarray:
        free = np.ones(len(points), dtype=bool)
        for low, high in boxes:
            free &= ~np.all((points >= low - margin) & (points <= high + margin), axis=1)
        for corners in walls:
            # Corners go around a sheet: its first and its last side span the plane.
            normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
            normal /= np.linalg.norm(normal)
            # Distance to the plane of a sheet; its box bounds the rest.
            near = np.abs((points - corners[0]) @ normal) < margin
            low, high = corners.min(0) - margin, corners.max(0) + margin
            free &= ~(near & np.all((points >= low) & (points <= high), axis=1))
        return free

    return allowed


def choose_farthest_rows(positions: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Choose rows (count,) of positions far apart: farthest-point order from a seeded start.

    >>> choose_farthest_rows(np.array([[0.0], [0.1], [9.0], [9.1]]), count=2, seed=0).shape
    (2,)
    """
    count = min(count, len(positions))
    chosen = [int(np.random.default_rng(seed).integers(len(positions)))]
    distance = np.linalg.norm(positions - positions[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        # To the nearest of those chosen so far.
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
        distance[chosen] = -1.0  # where places repeat, another row of one of them comes next
    return np.array(chosen)


def nearest_rows(positions: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the nearest other row of each of `rows`.

    >>> nearest_rows(np.array([[0.0], [1.0], [9.0]]), rows=np.array([2]))
    array([1])
    """
    nearest = cKDTree(positions).query(positions[rows], k=2)[1]
    # Of two rows at one place either may come first.
    return np.where(nearest[:, 0] == rows, nearest[:, 1], nearest[:, 0])

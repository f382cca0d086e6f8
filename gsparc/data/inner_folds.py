"""Folds inside the training and validation rows, cut as the test rows were cut from all:
for choosing models.

Errors of rows left out otherwise rank models wrongly: what interpolates well between neighbours (a
random cut) may extrapolate badly into a square of floor that nobody walked (blocks),
and the other way round.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.errors import DataError
from gsparc.data import spacing
from gsparc.data.schema import Measurements, TrainTest
from gsparc.data.spacing import neighbour_distance
from gsparc.data.split_settings import CORNERS, WHOLE, FileSettings, SplitSettings
from gsparc.data.splits import AnySplit, Fold, make_split

Draws = np.random.Generator
# Times the usual distance to the nearest training row, from which validation rows are apart
FARTHER = 2.0
SIDES = np.sqrt(2) ** np.arange(9)  # of squares tried for a file's gap, in units of that gap
HALVINGS = 6  # of the side of squares, where too few squares hold training rows
DRAWS = 12  # of squares per fold, of which those are taken that share the fewest rows
NOT_TESTED = -1  # unit of a row that no fold leaves out


@dataclass(frozen=True)
class InnerFolds:
    """Folds of the training and validation rows; `test` are rows left out.

    Attributes:
        name: of the split they are cut by, one of `gsparc.data.split_settings.NAMES`.
        folds: one or more, of rows as the outer fold counts them.
        unit: (S,) int64 of all rows, which were left out together as one: a place, a square, a
            station or a stretch; errors within a unit are not independent.
            `NOT_TESTED` of the rest.
    """

    name: str
    folds: tuple[Fold, ...]
    unit: np.ndarray


def inner_folds(
    positions: np.ndarray,
    fold: Fold,
    split: AnySplit | None,
    count: int,
    seed: int,
    place: np.ndarray | None = None,
    station: np.ndarray | None = None,
) -> InnerFolds:
    """Cut the training and validation rows of a fold as `split` cut the test rows off;
    a pure function.

    `random` and `sparse` leave out pieces of one permutation of the places, so that folds share
    none where `count` pieces fit; `sparse` does not thin again, as its training rows are thin
    already. `blocks` leaves out squares of the same side, `grouped` stretches as long, `corner` the
    other corners first, `stations` and `runs` as many of these at a time. Folds of a file are
    random, unless its validation rows lie clearly farther from training rows than these from one
    another: then squares as far apart. Where too few squares, stretches or units remain, squares
    are made smaller, then rows are drawn at random; `name` says so.

    Args:
        positions: (S, 3) [m] of the moving end, or (S, 6) of both, of all rows.
        fold: whose training and validation rows are cut.
        split: as the fold was made; None: at random.
        count: folds wanted; of stretches, corners and stations there may be fewer.
        seed: of the draws.
        place: (S,) int64; rows of one place stay together. None where every row is one.
        station: (S,) int64, of which station, for `runs` of which run, a row is.

    Raises:
        DataError: fewer than 2 places to cut.
    """
    rows = np.sort(fold.learned())
    positions, place = positions - positions.min(axis=0), spacing.group_visits(positions, place)
    number = (
        np.arange(len(rows)) if place is None else np.unique(place[rows], return_inverse=True)[1]
    )
    _, first, which = np.unique(number, return_index=True, return_inverse=True)
    which, where = which.reshape(-1), positions[rows][first]
    if len(where) < 2:
        raise DataError(f"{len(where)} training places are too few to leave any out; measure more")
    settings = _inside(positions, fold, split)
    rng = np.random.default_rng([seed, 4])
    cut = None
    if settings.name in WHOLE:
        if station is not None:
            unit = np.unique(station[rows], return_inverse=True)[1].reshape(-1)
            cut = _stations(unit, settings, count, rng)
        settings = replace(settings, name="random", leave_out=())
    if cut is None:
        cut = _cut(where, settings, count, rng)
    else:
        which = np.arange(len(rows))  # folds of rows, not of places
    folds = tuple(fold.map(lambda part: rows[np.isin(which, part)]) for fold in cut.folds)
    units = np.full(len(positions), NOT_TESTED)
    tested = np.isin(rows, np.concatenate([fold.test for fold in folds]))
    units[rows[tested]] = cut.unit[which][tested]
    return InnerFolds(cut.name, folds, units)


def cut_folds(
    data: Measurements, fold: Fold, split: AnySplit | None, count: int, seed: int
) -> InnerFolds:
    """Return `inner_folds` of measurements.

    Where both ends are taken for moving only because stations are learned together, what moves is
    the other end than theirs, as it was for the split.
    """
    positions = data.moving
    if data.site.paired and data.station is not None:
        positions = data.rx_position if _still(data.tx, data.station) else data.tx
    unit = data.run if split is not None and split.name == "runs" else data.station
    return inner_folds(positions, fold, split, count, seed, data.place, unit)


def _still(places: np.ndarray, station: np.ndarray) -> bool:
    """Whether places (S, 3) are the stations' (S,) own."""
    _, first, which = np.unique(station, return_index=True, return_inverse=True)
    return bool(np.allclose(places, places[first][which.reshape(-1)]))


def _inside(positions: np.ndarray, fold: Fold, split: AnySplit | None) -> SplitSettings:
    """The settings that cut inside what a split left: nothing is thinned or left out again."""
    if split is None:
        return SplitSettings()
    if isinstance(split, FileSettings):
        return _like_a_file(positions, fold)
    whole: dict[str, object] = {
        "thin": 1.0,
        "train_count": None,
        "spacing_m": None,
        "redraw": False,
        "end": None,
    }
    if split.name != "stations":
        whole["leave_out"] = ()
    # Nothing was held out that could be followed; or as dense as what is learned from: thinned
    # again it would be another task.
    if split.name in ("none", "sparse"):
        whole["name"] = "random"
    if split.name == "blocks" and split.side_m is None:
        whole["side_m"] = max(spacing.tenth_of_extent(positions[:, :2]), np.finfo(float).tiny)
    if split.name == "grouped":  # stretches as long as those of the test
        whole["folds"] = max(split.folds - 1, 2)
    return replace(split, **whole)  # type: ignore[arg-type]


def _like_a_file(positions: np.ndarray, fold: Fold) -> SplitSettings:
    """Random, or squares that leave rows as far from the others as validation rows are
    from training rows.
    """
    share = min(max(len(fold.val) / max(len(fold.train) + len(fold.val), 1), 0.1), 0.5)
    settings = SplitSettings(test_fraction=share, val_fraction=share)
    if not len(fold.val) or len(fold.train) < 2:
        return settings
    places = positions[fold.train]
    gap = float(np.median(cKDTree(places).query(positions[fold.val])[0]))
    if not gap > FARTHER * (neighbour_distance(places) or gap):
        return settings
    rows = np.sort(fold.learned())
    where = positions[rows]
    best, nearest = settings, np.inf
    for side in gap * SIDES:
        squares = SplitSettings("blocks", side_m=float(side), share=share, val_fraction=share)
        try:
            cut = make_split(where, squares).folds[0]
        except DataError:
            break
        learned = where[cut.learned()]
        distance = float(np.median(cKDTree(learned).query(where[cut.test])[0]))
        if abs(np.log(max(distance, 1e-12) / gap)) < nearest:
            best, nearest = squares, abs(np.log(max(distance, 1e-12) / gap))
    return best


def _cut(where: np.ndarray, settings: SplitSettings, count: int, rng: Draws) -> InnerFolds:
    """Folds of places (P, D), as the settings say or the nearest that is possible."""
    if settings.name == "blocks":
        side = settings.side_m or 0.0
        for _ in range(HALVINGS):
            try:
                folds = _draws(where, replace(settings, side_m=side), count, rng)
            except DataError:
                side /= 2
                continue
            return InnerFolds("blocks", folds, spacing.number_squares(where[:, :2], side))
    corners = [settings.corner]
    if settings.name == "corner":
        others = [corner for corner in CORNERS if corner != settings.corner]
        corners = [*map(str, rng.permutation(others)), settings.corner][:count]
    if settings.name in ("grouped", "corner"):
        with suppress(DataError):
            cut = [
                f
                for corner in corners
                for f in make_split(where, replace(settings, corner=corner)).folds
            ]
            chosen = (
                rng.permutation(len(cut))[:count] if settings.name == "grouped" else range(len(cut))
            )
            unit = np.full(len(where), NOT_TESTED)
            # A row of two folds is counted with the first
            for number, i in reversed([*enumerate(chosen)]):
                unit[cut[i].test] = number
            return InnerFolds(settings.name, tuple(cut[i] for i in chosen), unit)
    settings = replace(settings, name="random")
    pieces = _pieces(len(where), settings, count, rng)
    folds = tuple(make_split(where, settings, pair).folds[0] for pair in pieces)
    return InnerFolds("random", folds, np.arange(len(where)))


def _pieces(places: int, settings: SplitSettings, count: int, rng: Draws) -> Iterator[TrainTest]:
    """(training, test) places of each fold: pieces of one permutation,
    overlapping only where they must.
    """
    order = rng.permutation(places)
    size = min(max(round(settings.test_fraction * places), 1), places - 1)
    for number in range(min(count, places)):
        turned = np.roll(order, -round(number * places / min(count, places)))
        yield np.sort(turned[size:]), np.sort(turned[:size])


def _draws(
    where: np.ndarray,
    settings: SplitSettings,
    count: int,
    rng: Draws,
    station: np.ndarray | None = None,
) -> tuple[Fold, ...]:
    """`count` distinct draws of a split by seeds of their own, each with the fewest rows again."""
    seeds = rng.integers(2**31, size=DRAWS * count)
    folds = [
        make_split(where, replace(settings, seed=int(s)), station=station).folds[0] for s in seeds
    ]
    first, *rest = {fold.test.tobytes(): fold for fold in folds}.values()
    chosen = [first]
    while rest and len(chosen) < count:
        tested = np.concatenate([fold.test for fold in chosen])
        shared = [float(np.isin(fold.test, tested).mean()) for fold in rest]
        chosen.append(rest.pop(int(np.argmin(shared))))
    return tuple(chosen)


def _stations(
    station: np.ndarray, settings: SplitSettings, count: int, rng: Draws
) -> InnerFolds | None:
    """Folds of rows of stations or runs (n,) that leave out whole ones;
    None where there is one alone.
    """
    number, name = int(station.max()) + 1, settings.name
    together = max(min(settings.held_out_count(number), number - 2), 0)
    settings = replace(settings, name="stations", leave_out=together)
    where = np.zeros((len(station), 3))
    if number == 1:
        return None
    if number == 2:  # one to learn from; none is left to choose on
        none = np.zeros(0, np.int64)
        folds = [
            Fold(np.flatnonzero(station != t), none, np.flatnonzero(station == t)) for t in range(2)
        ]
    elif together <= 1:
        cuts = make_split(where, replace(settings, leave_out=0), station=station).folds
        folds = [cuts[i] for i in rng.permutation(number)[:count]]
    else:
        folds = list(_draws(where, settings, count, rng, station))
    return InnerFolds(name, tuple(folds), station)

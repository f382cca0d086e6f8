"""Training, validation and test rows: pure functions of positions and settings, stored with a hash."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsparc.data.blocks import evenly
from gsparc.data.errors import DataError, reason
from gsparc.data.files import whole_file
from gsparc.data.limits import POSITIVE, SHARE, Checked, Limit, choice, number, or_null, setting, whole
from gsparc.data.links.stations import numbered
from gsparc.data.schema import TrainTest

log = logging.getLogger(__name__)

NAMES = ("random", "grouped", "corner", "blocks", "sparse", "stations", "runs")
CORNERS = ("--", "-+", "+-", "++")
# Rows form a path while their median step is below this many nearest-neighbour distances.
PATH_STEP_RATIO = 4.0
LEAST_ROWS = 4  # fewer training rows than this teach nothing
NEAR = 0.01  # of the usual step: places nearer than this are visits of one
FEWEST_PLACES, SAMPLE = 10, 10_000  # that tell a usual step; more tell nothing more
# Large odd factors: cells become numbers, which sort much faster than rows.
_ODD = [0x1E3779B97F4A7C15, 0x2545F4914F6CDD1D, 0x3C6EF372FE94F82B, 7919, 104729**3, 3**38]
MIXING = 2**62 + np.array(_ODD)
EDGE = 1e-6  # of a square: places on its edge are in it, however they were rounded


@dataclass(frozen=True)
class Fold:
    """Disjoint row indices; `val` is for choosing and calibrating, never for reporting.

    Attributes:
        train, val, test: (n,) int64, sorted.
    """

    train: np.ndarray
    val: np.ndarray
    test: np.ndarray

    def each(self, change: Callable[[np.ndarray], np.ndarray]) -> Fold:
        """Return the three parts changed alike."""
        return Fold(*map(change, (self.train, self.val, self.test)))


@dataclass(frozen=True)
class Split:
    """One fold, or several whose test results are pooled.

    >>> places = np.random.default_rng(0).uniform(0, 9, (100, 3))
    >>> make_split(places, SplitSettings()).sha256 == make_split(places, SplitSettings(seed=1)).sha256
    False

    Attributes:
        name: one of `NAMES`, or a file's.
        folds: one or more folds.
        sha256: hash of all indices.
    """

    name: str
    folds: tuple[Fold, ...]
    sha256: str

    def check(self) -> None:
        """Refuse folds that teach nothing, or test nothing (DataError)."""
        for i, fold in enumerate(self.folds):
            if len(fold.train) < LEAST_ROWS or not len(fold.test):
                raise DataError(
                    f"split={self.name}: fold {i} has {len(fold.train)} training and {len(fold.test)} "
                    f"test rows; at least {LEAST_ROWS} and 1 are needed"
                )


def _are_rows(value: Any) -> bool:
    listed = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(listed, str) or not isinstance(listed, Sequence):
        return isinstance(listed, str) and listed == "outliers"
    return all(isinstance(r, int | np.integer) and not isinstance(r, bool) and r >= 0 for r in listed)


LeaveOut = Sequence[int] | Literal["outliers"]
ROWS = Limit("outliers, or a list of rows like [3, 17],", _are_rows)
KNOWN = Limit(f"one of {', '.join(NAMES)}, file", lambda name: name in NAMES, (*NAMES, "file"))


@dataclass(frozen=True)
class SplitSettings(Checked):
    """How to split; one instance of the config group `split`.

    >>> SplitSettings(test_fraction=1.5)
    Traceback (most recent call last):
        ...
    gsparc.data.limits.SettingError: test_fraction=1.5: a number above 0 and below 1 is needed

    Attributes:
        name: `random`, `grouped`, `corner`, `blocks`, `sparse`, `stations` or `runs`.
        seed: of every random choice below.
        val_fraction: share of each fold's training rows kept for validation.
        test_fraction: share of the rows that `random` (without files) and `corner` hold out, and of the runs
            that `runs` does, one at least.
        redraw: `random` ignores the release's own files and draws anew.
        folds: number of folds of `grouped`.
        stretches_per_fold: `grouped` cuts the path into folds x this many stretches.
        side_m: of the squares of floor that `blocks` holds out whole [m]; None: a tenth of the longer side.
        share: of the places, that `blocks` holds out at least.
        buffer_m: `grouped` and `corner` drop training rows this close to a test row [m].
        corner: of `corner`, lower or upper end in x and y as `--`, `-+`, `+-` or `++`.
        train_fraction: share of the rows that `sparse` trains on.
        train_count: thin each fold's training rows to this many (validation included); None keeps all.
        thin: the same as a share in (0, 1]; smaller sets are subsets of larger ones.
        spacing_m: keep only training rows at least this far apart, before the other two [m]; None keeps all.
        leave_out: rows that are neither learned from nor tested on, or `outliers`; of `stations`, how many
            are held out together, drawn by seed (0: each one in its turn).
    """

    name: str = setting("random", KNOWN)
    seed: int = setting(0, whole(0))
    val_fraction: float = setting(0.1, number(0, 1, open_high=True))
    test_fraction: float = setting(0.2, SHARE)
    redraw: bool = False
    folds: int = setting(5, whole(2))
    stretches_per_fold: int = setting(1, whole(1))
    side_m: float | None = setting(None, or_null(POSITIVE))
    share: float = setting(0.2, SHARE)
    buffer_m: float = setting(0.03, number(0))
    corner: str = setting("++", choice(*CORNERS))
    train_fraction: float = setting(0.1, SHARE)
    train_count: int | None = setting(None, or_null(whole(1)))
    thin: float = setting(1.0, number(0, 1, open_low=True))
    spacing_m: float | None = setting(None, or_null(POSITIVE))
    leave_out: LeaveOut | int = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        # `stations` takes a number of stations there; everything else a list of rows.
        if self.name != "stations" or type(self.leave_out) is not int or self.leave_out < 0:
            ROWS.check("leave_out", self.leave_out)


@dataclass(frozen=True)
class FileSettings(Checked):
    """The folds of an index file: the config group `split` with the name `file`.

    Attributes:
        path: as a run writes it, split.json.
        leave_out: see `SplitSettings`.
    """

    name: str = "file"
    path: str = ""
    leave_out: LeaveOut = setting((), ROWS)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.path, str | Path) or str(self.path) in ("", "???"):
            raise DataError("split.path is not set; say split.path=split.json for split=file")


AnySplit = SplitSettings | FileSettings


def make_split(
    positions: np.ndarray,
    settings: SplitSettings,
    release_split: TrainTest | None = None,
    outliers: np.ndarray | None = None,
    place: np.ndarray | None = None,
    station: np.ndarray | None = None,
) -> Split:
    """Split rows by the positions of the moving end; what is held out is so for all stations.

    >>> places = np.random.default_rng(0).uniform(0, 9, (100, 3))
    >>> fold = make_split(places, SplitSettings("random")).folds[0]
    >>> len(fold.train), len(fold.val), len(fold.test)
    (72, 8, 20)
    >>> [len(fold.test) for fold in make_split(places, SplitSettings("grouped", folds=4)).folds]
    [25, 25, 25, 25]

    Args:
        positions: (S, 3) [m] of the moving end, or (S, 6) of both; squares are counted from zero.
        settings: how.
        release_split: (train, test) rows that the release names; used by `random` only.
        outliers: (n,) rows that `leave_out=outliers` means.
        place: (S,) int64; rows of one place stay together. None where every row is one.
        station: (S,) int64, of which station, for `runs` of which run, a row is; needed by these two.

    Raises:
        DataError: a fold would have no training, or no test rows; a row to leave out that there is not.
    """
    rows, left = len(positions), settings.leave_out
    absent = np.zeros(0, np.int64) if isinstance(left, int) else left_out(left, outliers, rows)
    rows_left = np.setdiff1d(np.arange(rows), absent)
    # Of the rows that stand for their places, and the place of each row.
    first = which = np.arange(len(rows_left))
    if settings.name in ("stations", "runs"):
        local_folds = _whole(None if station is None else station[rows_left], settings)
    else:
        # Files of the release are its published split; `redraw` is for drawing others.
        its_own = settings.name == "random" and release_split is not None and not settings.redraw
        named = release_split if its_own else None
        if named is not None:
            # Rows were renumbered when some were left out: from numbers of the file to those that remain.
            train, test = (np.searchsorted(rows_left, np.intersect1d(part, rows_left)) for part in named)
            named = train, test
        elif place is not None:
            # One row stands for each place: splits are made of places, so that no visit is on both sides.
            _, first, which = np.unique(place[rows_left], return_index=True, return_inverse=True)
        where = positions[rows_left][first]
        pairs = enumerate(_pairs(where, settings, named))
        local_folds = tuple(_finish(i, train, test, where, settings) for i, (train, test) in pairs)
    folds = tuple(fold.each(lambda part: rows_left[np.isin(which.reshape(-1), part)]) for fold in local_folds)
    return Split(settings.name, folds, indices_hash(folds))


def _pairs(positions: np.ndarray, settings: SplitSettings, named: TrainTest | None) -> list[TrainTest]:
    """(training, test) rows of each fold, before thinning and validation."""
    if named is not None:
        return [named]
    if settings.name == "grouped":
        return _grouped(positions, settings)
    if settings.name == "corner":
        return [_corner(positions, settings)]
    rows = len(positions)
    if settings.name == "blocks":
        test = _blocks(positions, np.arange(rows), settings, settings.share, [settings.seed])
        return [(np.setdiff1d(np.arange(rows), test), test)]
    test_share = settings.test_fraction if settings.name == "random" else 1 - settings.train_fraction
    order = np.random.default_rng(settings.seed).permutation(rows)
    # At least one row on either side, as rounding may leave none of a small share.
    train_count = rows - min(max(round(test_share * rows), 1), max(rows - 1, 0))
    return [(np.sort(order[:train_count]), np.sort(order[train_count:]))]


def usual_step(positions: np.ndarray) -> float:
    """Return the median distance [m] from a place (n, D) to the nearest other; 0 where too few tell it.

    Looked for from coarse to fine, as all places may have been visited again: what lies in a cell is one, and
    the first step that is ten cells long stands.

    >>> round(usual_step(np.c_[np.arange(20.0), np.zeros(20)]), 3)  # along a line, every metre
    1.0
    """
    side = extent = float(np.ptp(positions, axis=0).max())
    while side > 1e-12 * extent:
        # Cells of the current side first, so that visits of one place do not make its step zero.
        places, step = positions[np.unique(_joined(positions, side, side / 2), return_index=True)[1]], 0.0
        if len(places) >= FEWEST_PLACES:
            some = places[evenly(len(places), SAMPLE)]
            step = float(np.median(cKDTree(places).query(some, k=2)[0][:, 1]))
        if step >= 10 * side:
            return step
        side = min(step or side, side) / 10
    return 0.0


def visits(positions: np.ndarray, place: np.ndarray | None = None) -> np.ndarray | None:
    """Return the place (S,) int64 of each row where those nearer than `NEAR` usual steps count as one.

    >>> line = np.c_[np.arange(20.0), np.zeros(20)]  # every metre, and once more 1 mm beside it
    >>> visits(np.r_[line, line + 1e-3])[[0, 1, 20, 21]].tolist()
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
    joined = _joined(places, reach / 4 / np.sqrt(places.shape[1]), 1.5 * reach)  # all nearer than `reach`
    return place if len(np.unique(joined)) == len(places) else numbered(joined[which.reshape(-1), None])


def _joined(places: np.ndarray, cell: float, reach: float) -> np.ndarray:
    """A number (n,) that places (n, D) share in a cell, or where one of each cell is within `reach` [m].

    Cells first: thousands of visits of one place would be millions of pairs.
    """
    corner = np.floor((places - places.min(axis=0)) / cell).astype(np.int64)
    # The sums wrap around on overflow, as a hash does: two cells hardly ever share a number.
    _, first, which = np.unique(corner @ MIXING[: corner.shape[1]], return_index=True, return_inverse=True)
    one, two = cKDTree(places[first]).query_pairs(reach, output_type="ndarray").T
    graph = coo_array((np.ones(len(one)), (one, two)), (len(first), len(first)))
    return np.asarray(connected_components(graph)[1][which.reshape(-1)])


def tenth(floor: np.ndarray) -> float:
    """Return the side [m] of squares of which ten hold the longer side of places (n, 2)."""
    return float(np.ptp(floor, axis=0).max()) / 10 * (1 + 2 * EDGE)


def square_of(floor: np.ndarray, side: float) -> np.ndarray:
    """Return the number (n,) of the square of `side` [m] that each place (n, 2) is in, from zero.

    >>> square_of(np.array([[0.5, 0.5], [0.9, 0.1], [3.5, 0.5]]), side=1.0)
    array([0, 0, 1])
    """
    # Counted from zero, which `split_for` puts at the lowest place of the whole campaign.
    return np.unique(np.floor(floor / side + EDGE), axis=0, return_inverse=True)[1].reshape(-1)


def left_out(leave_out: LeaveOut, outliers: np.ndarray | None, rows: int) -> np.ndarray:
    """Return the rows (n,) int64 of `rows` that `leave_out` names, `outliers` (n,) being those of that name.

    >>> left_out([3, 17], None, rows=20)
    array([ 3, 17])

    Raises:
        DataError: there is no such row.
    """
    named = outliers if isinstance(leave_out, str) else leave_out
    absent = [int(row) for row in (() if named is None else named)]
    if max(absent, default=-1) >= rows:
        raise DataError(f"split.leave_out: row {max(absent)} of rows 0 to {rows - 1}")
    return np.array(absent, dtype=np.int64)


def without(split: Split, absent: np.ndarray) -> Split:
    """Return the same folds without the rows `absent` (n,)."""
    folds = tuple(fold.each(lambda part: np.setdiff1d(part, absent)) for fold in split.folds)
    return Split(split.name, folds, indices_hash(folds))


def path_order(positions: np.ndarray) -> np.ndarray:
    """Return the rows (S,) in the order of the measuring path.

    Rows taken one after the other keep their order. Where consecutive rows are far apart compared with
    nearest neighbours (a shuffled file, random drops) there is no path: rows are ordered along the
    longest side of the box, so that a stretch becomes a slab.

    >>> path_order(np.array([[0.0, 0, 0], [9, 0, 0], [1, 0, 0], [8, 0, 0], [2, 0, 0]]))  # no path: along x
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


def far_from(positions: np.ndarray, rows: np.ndarray, others: np.ndarray, distance: float) -> np.ndarray:
    """Return those `rows` that are more than `distance` [m] away from all `others` (rows).

    >>> line = np.arange(5.0)[:, None]
    >>> far_from(line, np.array([0, 1, 2]), np.array([4]), distance=2.5)
    array([0, 1])
    """
    if len(rows) == 0 or len(others) == 0:
        return rows
    return rows[cKDTree(positions[others]).query(positions[rows])[0] > distance]


def far_apart(
    positions: np.ndarray, rows: np.ndarray, distance: float, seed: list[int] | np.random.Generator
) -> np.ndarray:
    """Return a largest-as-drawn subset of `rows`, sorted, in which no two are closer than `distance` [m].

    >>> line = np.arange(9.0)[:, None]
    >>> rows = far_apart(line, np.arange(9), distance=2.0, seed=[0])
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


def indices_hash(folds: tuple[Fold, ...]) -> str:
    """Return the SHA-256 of all indices of all folds."""
    digest = hashlib.sha256()
    for fold in folds:
        for part in vars(fold).values():
            # The length first: moving a row from one part to the next changes the hash.
            digest.update(len(part).to_bytes(8, "little") + part.astype("<i8").tobytes())
    return digest.hexdigest()


def write_split(
    path: str | Path, split: Split, rows: int, dataset_sha256: str = "", run_id: str | None = None
) -> None:
    """Store a split of `rows` rows as a JSON index file (atomically), with the run that made it."""
    facts = {"schema": 1, "name": split.name, "rows": rows, "dataset_sha256": dataset_sha256}
    facts |= {} if run_id is None else {"run_id": run_id}
    folds = [{name: part.tolist() for name, part in vars(fold).items()} for fold in split.folds]
    content = {**facts, "sha256": split.sha256, "folds": folds}
    with whole_file(path) as partial:
        partial.write_text(json.dumps(content) + "\n", encoding="utf-8")


def read_split(path: str | Path, rows: int, dataset_sha256: str = "") -> Split:
    """Read an index file for a dataset of `rows` rows; warns when it was made for other data.

    Raises:
        DataError: not an index file, made for another number of rows, edited, or with overlapping parts.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        folds = tuple(
            Fold(*(np.array(f[k], dtype=np.int64).reshape(-1) for k in ("train", "val", "test")))
            for f in content["folds"]
        )
        name, stored_rows, stored_hash = str(content["name"]), int(content["rows"]), str(content["sha256"])
    except FileNotFoundError:
        raise DataError(f"{path}: no such split file; a run writes one as split.json") from None
    # Whatever a damaged or foreign JSON file raises: deep brackets, huge numbers, other types.
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"{path}: not a split file ({type(error).__name__}: {reason(error)})") from None
    if stored_rows != rows:
        raise DataError(f"{path}: made for {stored_rows} rows, the dataset has {rows}")
    for i, fold in enumerate(folds):
        every = np.concatenate([fold.train, fold.val, fold.test])
        if len(np.unique(every)) != len(every):
            raise DataError(f"{path}: fold {i} names a row twice (train, val and test must be disjoint)")
        if len(every) and (every.min() < 0 or every.max() >= rows):
            raise DataError(f"{path}: fold {i} names a row outside 0 to {rows - 1}")
    if not folds or indices_hash(folds) != stored_hash:
        raise DataError(f"{path}: the indices do not match their sha256; the file was edited or damaged")
    if dataset_sha256 and content.get("dataset_sha256") not in ("", None, dataset_sha256):
        log.warning("%s was made for other data (their content hashes differ); rows may not correspond", path)
    return Split(name, folds, stored_hash)


def _grouped(positions: np.ndarray, settings: SplitSettings) -> list[TrainTest]:
    """Each fold tests on whole stretches of the path, training rows near them dropped."""
    order = path_order(positions)
    if len(order) < 2 * settings.folds * settings.stretches_per_fold:
        raise DataError(
            f"split=grouped: {len(order)} rows are too few for {settings.folds} folds of "
            f"{settings.stretches_per_fold} stretches; lower split.folds or take split=random"
        )
    stretches = np.array_split(order, settings.folds * settings.stretches_per_fold)
    pairs = []
    for fold in range(settings.folds):
        # Every folds-th stretch: one fold's stretches lie all over the site.
        test = np.concatenate(stretches[fold :: settings.folds])
        # Path order is kept here: the validation stretch is cut from it.
        rest = order[~np.isin(order, test)]
        pairs.append((far_from(positions, rest, test, settings.buffer_m), np.sort(test)))
    return pairs


def _blocks(
    positions: np.ndarray, rows: np.ndarray, settings: SplitSettings, share: float, seed: list[int]
) -> np.ndarray:
    """Those of `rows` in whole squares of floor, drawn until they are a `share` of `rows` at least."""
    floor = positions[:, :2]
    side = settings.side_m or tenth(floor)
    if not side > 0:
        raise DataError("split=blocks: all positions are one above the other, there are no squares of floor")
    square = square_of(floor[rows], side)
    order = np.random.default_rng(seed).permutation(square.max() + 1)
    # Whole squares are added until the share is reached: the test set is never smaller.
    sizes = np.cumsum(np.bincount(square)[order])
    count = int(np.searchsorted(sizes, share * len(rows))) + 1
    if count >= len(order):
        raise DataError(
            f"split=blocks: {len(order)} squares of {side:.3g} m, too few to hold some out; lower "
            "split.side_m or split.share"
        )
    return rows[np.isin(square, order[:count])]


def _whole(unit: np.ndarray | None, settings: SplitSettings) -> tuple[Fold, ...]:
    """Folds that each hold out a station, or one that holds out `leave_out` of them, or a share of the runs.

    Args:
        unit: (S,) int64 number of each row's station, or run.
    """
    name = settings.name
    if unit is None:
        raise DataError(f"split={name}: these measurements have one {name[:-1]}; take split=random or blocks")
    unit = np.unique(unit, return_inverse=True)[1].reshape(-1)
    count = int(unit.max()) + 1
    together = settings.leave_out if isinstance(settings.leave_out, int) else 0
    if name == "runs":
        together = max(round(settings.test_fraction * count), 1)
    least = 2 if name == "stations" else 1
    if count - max(together, 1) < least:
        remain = "two at least must remain" if least == 2 else "one must remain"
        raise DataError(f"split={name}: {count} {name}; {remain} to learn from and to choose on")
    draw = np.random.default_rng(settings.seed).permutation(count)
    test_units = [draw[:together]] if together else [np.array([t]) for t in range(count)]
    folds = []
    for fold, test in enumerate(test_units):
        rest = np.setdiff1d(np.arange(count), test)
        rest = np.random.default_rng([settings.seed, fold, 2]).permutation(rest)
        # At least one to choose on, and one to learn from.
        chosen = rest[: min(max(round(settings.val_fraction * len(rest)), 1), len(rest) - 1)]
        parts = (np.setdiff1d(rest, chosen), chosen, test)
        folds.append(Fold(*(np.flatnonzero(np.isin(unit, part)) for part in parts)))
    return tuple(folds)


def _corner(positions: np.ndarray, settings: SplitSettings) -> TrainTest:
    """A rectangle in one corner of the site, seen from above, holding `test_fraction` of the rows."""
    lower, extent = positions[:, :2].min(axis=0), np.ptp(positions[:, :2], axis=0)
    # A site without extent along an axis is divided by 1: that axis tells no row from another.
    unit = (positions[:, :2] - lower) / np.where(extent > 0, extent, 1.0)
    corner = np.array([sign == "+" for sign in settings.corner], dtype=np.float64)
    # The larger of the two distances: its level lines are rectangles about the corner.
    depth = np.abs(unit - corner).max(axis=1)
    count = max(round(settings.test_fraction * len(positions)), 1)
    test = np.sort(np.argsort(depth, kind="stable")[:count])
    rest = np.setdiff1d(np.arange(len(positions)), test)
    return far_from(positions, rest, test, settings.buffer_m), test


def _finish(fold: int, train: np.ndarray, test: np.ndarray, positions: np.ndarray, s: SplitSettings) -> Fold:
    """Thin the training rows, then set some of them aside for validation."""
    if s.spacing_m is not None:
        train = far_apart(positions, train, s.spacing_m, [s.seed, fold, 3])
    # A stream of draws for each purpose (1 thinning, 2 validation, 3 spacing): none shifts another's.
    rng = np.random.default_rng([s.seed, fold, 1])
    keep = len(train) if s.train_count is None else s.train_count
    keep = max(min(keep, round(s.thin * len(train))), 1) if len(train) else 0
    # A prefix of one permutation: smaller training sets are subsets of larger ones.
    train = train[np.sort(rng.permutation(len(train))[:keep])]
    if len(train) == 0 or len(test) == 0:
        raise DataError(
            f"split={s.name}: fold {fold} has {len(train)} training and {len(test)} test rows of "
            f"{len(positions)}; measure more, or change split.buffer_m or the shares"
        )
    count = min(round(s.val_fraction * len(train)), len(train) - 1)
    if s.val_fraction > 0 and len(train) > 1:
        count = max(count, 1)
    rng = np.random.default_rng([s.seed, fold, 2])
    if s.name == "grouped":
        # A stretch in one piece: single rows between training rows of a path would be too easy.
        start = int(rng.integers(len(train) - count + 1))
        chosen = np.arange(start, start + count)
    elif s.name == "blocks" and count:
        # Validation as hard as the test: whole squares as well.
        chosen = np.searchsorted(train, _blocks(positions, train, s, s.val_fraction, [s.seed, fold, 2]))
    else:
        chosen = rng.permutation(len(train))[:count]
    val = train[chosen]
    return Fold(np.sort(np.setdiff1d(train, val)), np.sort(val), np.sort(test).astype(np.int64))

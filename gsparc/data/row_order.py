"""Rows by what they hold: copies of others, and an order that does not depend on the file's.

A file's order is chance: whatever draws rows by number draws others from the same rows shuffled. In
an order that content decides it draws the same ones. Near places stand near each other,
as along a drive.
"""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np

from gsparc.base.hashes import hash_rows
from gsparc.data.moments import number_moments
from gsparc.data.schema import Measurements
from gsparc.data.spacing import number_places
from gsparc.data.splits import Fold

BITS = 20  # of a coordinate, of three; of both ends half as many
REVISITED = 0.5  # of a device's places: where more hold different levels, rows are visits
PACKETS = 8  # different levels of a fix, from which on equal ones count as often as they are
APART_DB = 5.0  # from the mean of a fix, that no level of it is away


def find_copies(link: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Tell which rows (n,) repeat earlier ones,
    as of a packet logged twice or of files that overlap.

    >>> find_copies(np.array([0, 1, 0]), np.array([[2j], [2j], [2j]]))
    array([False, False,  True])

    Args:
        link: (n,) numbers of where and with which station a row was measured.
        values: (n, ...) that were measured.
    """
    turn, _ = _turns(hash_rows(link, values))
    return turn > 0


def merge_fixes(
    link: np.ndarray, fix: np.ndarray, level_db: np.ndarray, device: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return levels (n,), of rows of one fix their mean,
    and which rows (n,) bool that leaves over.

    A phone logs a fix several times, and copies: one measurement, with the error of its place.
    Where most places hold several levels they were visited, and visits are copies only if all of
    them stand there equally often. The place of a copy may jitter (`link`), that of a fix is one.

    >>> fix, level = np.array([0, 0, 1, 2]), np.array([-70.0, -71, -90, -60])
    >>> merge_fixes(fix, fix, level, np.zeros(4))
    (array([-70.5, -71. , -90. , -60. ]), array([False,  True, False, False]))

    Args:
        link, fix: (n,) numbers of where, with which station and by which device a row was measured.
        level_db: (n,) [dB], not finite where nothing was heard.
        device: (n,) labels, each of which is judged alone.
    """
    silent = ~np.isfinite(level_db)
    result, over = level_db.copy(), silent.copy()
    if silent.any():
        over[silent] = find_copies(link[silent], level_db[silent])
    for name in np.unique(device):
        rows = np.flatnonzero((device == name) & ~silent)
        if not len(rows):
            continue
        level, turned = level_db[rows], _turns(hash_rows(link[rows], level_db[rows]))
        _, first, of = np.unique(fix[rows], return_index=True, return_inverse=True)
        # Of different values alone, or copies would decide; sums in an order that no file has
        _, once, copies = np.unique(np.c_[of, level], axis=0, return_index=True, return_counts=True)
        differ = np.bincount(of[once])
        copies = np.where(differ[of[once]] < PACKETS, 1, copies)
        mean = np.bincount(of[once], copies * level[once]) / np.bincount(of[once], copies)
        # Beyond that a fix stood still on a way, or a mark of silence stands among levels.
        middle = (np.bincount(of[once], level[once]) / differ)[of[once]]
        whole = np.bincount(of[once], np.abs(level[once] - middle) > APART_DB) == 0
        if (differ > 1).mean() <= REVISITED:
            result[rows[first[whole]]] = mean[whole]
            over[rows] = (turned[0] > 0) | (whole[of] & (np.arange(len(rows)) != first[of]))
        else:
            over[rows] = turned[0] >= turned[1] // np.gcd.reduce(turned[1])
    return result, over


def _turns(number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How often each of numbers (n,) stood there before, and stands there in all."""
    _, which, count = np.unique(number, return_inverse=True, return_counts=True)
    turn = np.empty(len(number), np.int64)
    turn[np.argsort(which, kind="stable")] = np.arange(len(number)) - np.repeat(
        np.cumsum(count) - count, count
    )
    return turn, count[which]


def order_rows(data: Measurements, fold: Fold) -> tuple[Measurements, Fold]:
    """Return all rows in an order that their content decides, places numbered anew, and their fold.

    Neighbours along a curve that fills space stand together; of the rows of a place, those of one
    moment. The order of the file stays known (`sequence`): errors that drift are seen in no other.
    """
    if not (_LAST and _LAST[0][0]() is data):
        order = content_order(data)
        sequence = order if data.sequence is None else data.sequence[order]
        ordered, rank = replace(data.subset(order), sequence=sequence), np.argsort(order)
        if ordered.place is not None:
            ordered = replace(ordered, place=number_places(ordered.place[:, None]))
        _LAST[:] = [(weakref.ref(data), ordered, rank)]
    _, ordered, rank = _LAST[0]
    return ordered, fold.map(lambda rows: np.sort(rank[rows]))


# Of the last measurements the ordered ones, and where each row stands there: baselines share them.
_LAST: list[tuple[weakref.ref[Measurements], Measurements, np.ndarray]] = []


def content_order(data: Measurements) -> np.ndarray:
    """Return the numbers (S,) of rows in the order of `order_rows`."""
    row = hash_rows(
        *(data.tx, data.rx_position, data.rx_rotation, data.target, data.mask, data.noise_variance),
        *(data.censored, data.position_std, data.uplink, data.device),
    )
    rows = np.arange(len(data))
    # Visits are counted in the order of the file, and only channels, whose phases moments share,
    # need them.
    moment = number_moments(data, rows) if data.site.target.is_complex else rows
    together = np.zeros(len(data), np.uint64)
    np.add.at(together, moment, row)
    # The largest moment of a place first: counting visits then finds the same moments again.
    largest = -np.bincount(moment)[moment]
    # Stations at one place, and runs, may have measured the same:
    # their numbers are of the file's order.
    names = data.site.every_station.shown
    several = len(names) > 1  # rows of one may have its number among others
    station = np.unique(names, return_inverse=True)[1][data.stations_of()] if several else rows * 0
    among = data.runs_of(rows), station, row
    return np.lexsort(
        (*among, together[moment], largest, hash_rows(data.moving), morton_codes(data.moving))
    )


def morton_codes(places: np.ndarray) -> np.ndarray:
    """Return numbers (n,) of places (n, D) along a curve that fills their box:
    bits of axes in turns.
    """
    bits, axes = 3 * BITS // places.shape[1], places.shape[1]
    low, width = places.min(axis=0), float(np.ptp(places, axis=0).max()) or 1.0
    cell = ((places - low) / width * (2**bits - 1)).astype(np.uint64)
    shifts = [(np.uint64(bit), np.uint64(bit * axes)) for bit in range(bits)]
    turns = (((cell >> bit) & np.uint64(1)) << shift for bit, shift in shifts)
    return (sum(turns) << np.arange(axes, dtype=np.uint64)).sum(axis=1, dtype=np.uint64)

"""Rows by what they hold: copies of others, and an order that does not depend on the file's.

A file's order is chance: whatever draws rows by number draws others from the same rows shuffled. In an order
that content decides it draws the same ones. Near places stand near each other, as along a drive.
"""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np

from gsparc.data.blocks import row_blocks, take
from gsparc.data.links.stations import number_places
from gsparc.data.moments import number_moments
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold

BITS = 20  # of a coordinate, of three; of both ends half as many
REVISITED = 0.25  # of the places with several rows: from there on equal powers were measured again


def hash_rows(*arrays: np.ndarray | None) -> np.ndarray:
    """Return a number (n,) uint64 of the bytes that each row of arrays (n, ...) holds; None are left out.

    >>> one, two, again = hash_rows(np.array([[1.0, 2.0], [2.0, 1.0], [1.0, 2.0]])).tolist()
    >>> one == again, one == two
    (True, False)
    """
    inputs = [array for array in arrays if array is not None]
    draws, result = np.random.default_rng(0), np.zeros(len(inputs[0]), np.uint64)
    for array in inputs:
        width = -(-array[:1].nbytes // 4)
        factors = draws.integers(1, 2**63, width, np.uint64) * 2 + 1
        for part in row_blocks(array):
            rows = np.ascontiguousarray(array[part]).reshape(len(array[part]), -1).view(np.uint8)
            words = np.pad(rows, ((0, 0), (0, 4 * width - rows.shape[1]))).view(np.uint32)
            # Sums wrap around: multiplied by random odd numbers, different rows hardly ever agree.
            result[part] += words.astype(np.uint64) @ factors
    return result


def find_copies(place: np.ndarray, link: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Tell which rows (n,) repeat earlier ones, as of a packet logged twice or of files that overlap.

    Coarse levels of a place that was visited again agree by chance: where visits differ, rows are copies only
    if all of them stand there equally often.

    Args:
        place, link: (n,) numbers of where a row was measured, and of where and with which station.
        values: (n, ...) that were measured.
    """
    of, size = np.unique(link, return_inverse=True, return_counts=True)[1:]
    rows = np.flatnonzero(size[of] > 1)
    copies, at = np.zeros(len(link), bool), place[rows]
    if not len(rows):
        return copies
    first, which, count = np.unique(
        hash_rows(link[rows], take(values, rows)), return_index=True, return_inverse=True, return_counts=True
    )[1:]
    turn = np.empty(len(rows), np.int64)  # how often each stood there before
    turn[np.argsort(which, kind="stable")] = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    differing = at[np.bincount(of[rows[first]])[of[rows]] > 1]
    once = np.ones(len(count), np.int64)
    if values[0].size == 1 and len(np.unique(differing)) >= REVISITED * len(np.unique(at)):
        once = count // (np.gcd.reduce(count) if len(rows) == len(link) else 1)
    copies[rows] = turn >= once[which]
    return copies


def order_rows(data: Measurements, fold: Fold) -> tuple[Measurements, Fold]:
    """Return all rows in an order that their content decides, places numbered anew, and their fold.

    Neighbours along a curve that fills space stand together; of the rows of a place, those of one moment.
    The order of the file stays known (`sequence`): errors that drift are seen in no other.
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
    # Visits are counted in the order of the file, and only channels, whose phases moments share, need them.
    moment = number_moments(data, rows) if data.site.target.is_complex else rows
    together = np.zeros(len(data), np.uint64)
    np.add.at(together, moment, row)
    # The largest moment of a place first: counting visits then finds the same moments again.
    largest = -np.bincount(moment)[moment]
    # Stations at one place, and runs, may have measured the same: their numbers are of the file's order.
    names = data.site.every_station.shown
    several = len(names) > 1  # rows of one may have its number among others
    station = np.unique(names, return_inverse=True)[1][data.stations_of()] if several else rows * 0
    among = data.runs_of(rows), station, row
    return np.lexsort((*among, together[moment], largest, hash_rows(data.moving), along_curve(data.moving)))


def along_curve(places: np.ndarray) -> np.ndarray:
    """Return numbers (n,) of places (n, D) along a curve that fills their box: bits of axes in turns."""
    bits, axes = 3 * BITS // places.shape[1], places.shape[1]
    low, width = places.min(axis=0), float(np.ptp(places, axis=0).max()) or 1.0
    cell = ((places - low) / width * (2**bits - 1)).astype(np.uint64)
    shifts = [(np.uint64(bit), np.uint64(bit * axes)) for bit in range(bits)]
    turns = (((cell >> bit) & np.uint64(1)) << shift for bit, shift in shifts)
    return (sum(turns) << np.arange(axes, dtype=np.uint64)).sum(axis=1, dtype=np.uint64)

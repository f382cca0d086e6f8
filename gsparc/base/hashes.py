"""Numbers that the bytes of rows decide: equal rows have equal ones, and others hardly ever do."""

from __future__ import annotations

import numpy as np

BLOCK = 2**24  # bytes that are copied at a time


def hash_rows(*arrays: np.ndarray | None) -> np.ndarray:
    """Return a number (n,) uint64 of the bytes that each row of arrays (n, ...) holds;
    None are left out.

    >>> one, two, again = hash_rows(np.array([[1.0, 2.0], [2.0, 1.0], [1.0, 2.0]])).tolist()
    >>> one == again, one == two
    (True, False)
    """
    inputs = [array for array in arrays if array is not None]
    draws, result = np.random.default_rng(0), np.zeros(len(inputs[0]), np.uint64)
    for array in inputs:
        width = -(-array[:1].nbytes // 4)
        factors = draws.integers(1, 2**63, width, np.uint64) * 2 + 1
        step = max(BLOCK // max(4 * width, 1), 1)
        for start in range(0, len(array), step):
            block = np.ascontiguousarray(array[start : start + step])
            rows = block.reshape(len(block), -1).view(np.uint8)
            words = np.pad(rows, ((0, 0), (0, 4 * width - rows.shape[1]))).view(np.uint32)
            # Sums wrap around: multiplied by random odd numbers, different rows hardly ever agree.
            result[start : start + step] += words.astype(np.uint64) @ factors
    return result


def shuffle_rows(seed: int | np.random.Generator, *arrays: np.ndarray) -> np.ndarray:
    """Return an order (n,) int64 of rows of arrays (n, ...) that looks drawn, decided by content.

    A row that comes or goes leaves the order of all others as it is: what is chosen by its first
    rows hardly changes with it.

    >>> places = np.random.default_rng(0).uniform(size=(9, 2))
    >>> order = shuffle_rows(0, places)
    >>> less = shuffle_rows(0, places[1:]) + 1
    >>> bool((order[order > 0] == less).all())
    True
    """
    draws = np.random.default_rng(seed)
    number = hash_rows(*arrays)
    for shift in (31, 29):  # Sums of near places are near; their mixtures are not.
        number ^= number >> np.uint64(shift)
        number *= draws.integers(1, 2**63, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    return np.argsort(number, kind="stable")

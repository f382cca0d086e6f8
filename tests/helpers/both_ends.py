"""Levels between two places of a floor with inner walls: the same from A to B as from B to A."""

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.tables.own import from_arrays

SIZE, HEIGHT = np.array([24.0, 14.0]), 1.2  # of the floor, and of both ends [m]
LOSS_DB, MIRRORED_DB, WAVE = 7.0, 6.0, 0.125  # of an inner wall, of a reflection; wavelength [m]


def inner_walls(rng: np.random.Generator, count: int = 10) -> np.ndarray:
    """Walls (count, 2, 2) [m] along either axis."""
    start, along = rng.uniform(0, SIZE, (count, 2)), np.eye(2)[np.arange(count) % 2]
    return np.stack([start, start + along * rng.uniform(3, 8, (count, 1))], 1)


def crossings(a: np.ndarray, b: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """How many walls each way from a (n, 2) to b (n, 2) crosses."""

    def side(p, q, r):
        (u, v), (s, t) = (np.moveaxis(x, -1, 0) for x in (q - p, r - p))
        return np.sign(u * t - v * s)

    p, q, a, b = walls[:, 0], walls[:, 1], a[:, None], b[:, None]
    parted = (side(a, b, p) != side(a, b, q)) & (side(p, q, a) != side(p, q, b))
    return parted.sum(1)


def walled_levels(tx: np.ndarray, rx: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Levels (n,) [dB] of the straight way and of four that a side of the floor mirrors."""
    loss = LOSS_DB * crossings(tx, rx, walls)
    field = _wave(np.linalg.norm(rx - tx, axis=1), loss)
    for axis, at in ((0, 0.0), (0, SIZE[0]), (1, 0.0), (1, SIZE[1])):
        image = tx.copy()
        image[:, axis] = 2 * at - tx[:, axis]
        share = (at - rx[:, axis]) / (image[:, axis] - rx[:, axis])
        touch = rx + share[:, None] * (image - rx)
        passed = crossings(tx, touch, walls) + crossings(touch, rx, walls)
        far = np.linalg.norm(rx - image, axis=1)
        field = field + _wave(far, LOSS_DB * passed + MIRRORED_DB)
    return 20 * np.log10(np.abs(field))


def _wave(far: np.ndarray, loss: np.ndarray) -> np.ndarray:
    far = np.maximum(far, 0.3)
    return 10 ** (-loss / 20) * WAVE / (4 * np.pi * far) * np.exp(-2j * np.pi * far / WAVE)


def walled_floor(rows: int, stations: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Arrays of so many links, transmitters at so many places, receivers anywhere."""
    rng = np.random.default_rng(seed)
    walls, places = inner_walls(rng), rng.uniform(0, SIZE, (stations, 2))
    rx, tx = rng.uniform(0, SIZE, (rows, 2)), places[np.arange(rows) % stations]
    level = walled_levels(tx, rx, walls) + rng.normal(0, 1.0, rows)
    height = np.full((rows, 1), HEIGHT)
    ends = {"tx_position": np.hstack([tx, height]), "rx_position": np.hstack([rx, height])}
    return {**ends, "rssi_db": level, "carrier_hz": np.array(3e8 / WAVE)}


def walled_measurements(rows: int, stations: int, seed: int = 0) -> Measurements:
    """The same as they are learned from."""
    return from_arrays(walled_floor(rows, stations, seed), {"name": "walls"})

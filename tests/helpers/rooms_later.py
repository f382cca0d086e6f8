"""A room of powers where later a cabinet stands: levels with a known truth."""

from pathlib import Path

import numpy as np
import torch

from gsparc.processes.later_rows import LaterRows

SIZE, HEIGHT, CABINET, RADIUS = 20.0, 1.5, np.array([5.0, 5.0]), 4.0


def draw(count: int, seed: int) -> np.ndarray:
    """Places (count, 3) on the floor [m]."""
    places = np.random.default_rng(seed).uniform(0, SIZE, (count, 2))
    return np.c_[places, np.full(count, HEIGHT)]


def truth(places: np.ndarray, change: float = 0.0, offset: float = 0.0) -> np.ndarray:
    """Levels (n,) [dB] at places (n, 3): some waves, `change` around the cabinet,
    `offset` everywhere.
    """
    rng = np.random.default_rng(1)
    waves, phase, weight = (
        rng.normal(size=(40, 2)) / 2,
        rng.uniform(0, 2 * np.pi, 40),
        rng.normal(size=40),
    )
    level = -60 + 3 * np.cos(places[:, :2] @ waves.T + phase) @ weight / np.sqrt(20)
    return level + offset + change * behind(places)


def behind(places: np.ndarray) -> np.ndarray:
    """Which places (n, 3) are in the shadow of the cabinet."""
    return np.linalg.norm(places[:, :2] - CABINET, axis=1) < RADIUS


def levels(places: np.ndarray, seed: int, **changed: float) -> np.ndarray:
    """Measured (n,) [dB], with 1 dB of noise."""
    return truth(places, **changed) + np.random.default_rng(100 + seed).normal(size=len(places))


PLACES = draw(300, 0)
SCREENED = draw(2000, 7)
SCREENED = SCREENED[np.linalg.norm(SCREENED[:, :2] - CABINET, axis=1) < RADIUS / 2]


def room_file(path: Path, count: int, seed: int = 5, **changed: float) -> Path:
    """A file of later rows of the same transmitter."""
    places = draw(count, seed)
    np.savez(
        path,
        rx_position=places,
        tx_position=np.array([9.0, 9.0, 2.6]),
        rssi_db=levels(places, seed, **changed),
    )
    return path


def later_rows(count: int, seed: int, **changed: float) -> LaterRows:
    """Rows of one station that miss a flat map of -60 dB, whose error has a variance of .5 dB^2,
    noise 4.
    """
    places, rng = draw(count, seed), np.random.default_rng(seed)
    missed = truth(places, **changed) - truth(places) + rng.normal(0, np.sqrt(4.5), count)
    number, flat = torch.arange(count), np.ones(count)
    parts = places, -60 * flat, missed, 0.5 * flat, 4 * flat
    return LaterRows(number, 0 * number, *map(torch.from_numpy, parts), number < 0)
